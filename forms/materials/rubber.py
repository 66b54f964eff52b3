"""Rubbers: isochoric invariants of S̄ = J^(-1/3) S, and κ/2 (J - 1)² with κ = λ + 2μ/3.

In 2D the third principal stretch is 1 (plane strain).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from forms.materials.base import Material, constant, plane_strain
from forms.spectral import traces_of_powers


def _volumetric(J: Expr, mu: Expr, lam: Expr) -> Expr:
    return (lam + 2 * mu / 3) / 2 * (J - 1) ** 2


@dataclass(frozen=True)
class MooneyRivlin(Material):
    """Ψ = c₁ (Ī₁ - 3) + c₂ (Ī₂ - 3) + κ/2 (J - 1)², J = det S > 0.

    Ī₁, Ī₂ are the invariants of S̄², and 2 (c₁ + c₂) = μ.

    Attributes:
        m: Share c₂ / (c₁ + c₂) of the second invariant [-], from 0 (neo-Hookean) to 1.

    Raises:
        ValueError: E, nu or m out of range.
    """

    m: float = 0.2

    formula = "Ψ = μ/2 ((1 - m) (Ī₁ - 3) + m (Ī₂ - 3)) + κ/2 (J - 1)², κ = λ + 2μ/3, J = det S > 0"
    description = "Mooney-Rivlin rubber, m = 0.2 of it in the second invariant"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.m <= 1.0:
            raise ValueError(f"m is {self.m}; the second invariant's share must lie in [0, 1]")

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        m, J, C = constant(S, self.m), ufl.det(S), S * S
        I1 = ufl.tr(C) + plane_strain(S)
        I2 = (I1**2 - ufl.inner(C, C) - plane_strain(S)) / 2
        isochoric = (1 - m) * (J ** (-2 / 3) * I1 - 3) + m * (J ** (-4 / 3) * I2 - 3)
        return mu / 2 * isochoric + _volumetric(J, mu, lam)


@dataclass(frozen=True)
class Ogden(Material):
    """Ψ = Σₚ 2μ wₚ/αₚ² (tr S̄^αₚ - 3) + κ/2 (J - 1)², J = det S > 0, S positive definite.

    The default exponents and weights are those of R. W. Ogden, Large deformation isotropic
    elasticity, Proc. R. Soc. Lond. A 326 (1972), which fit vulcanised rubber.

    Attributes:
        exponents: αₚ [-], none of them 0.
        weights: Share wₚ of each term in the shear modulus [-]; positive, with sum 1.

    Raises:
        ValueError: E, nu, exponents or weights out of range.
    """

    exponents: tuple[float, ...] = (1.3, 5.0, -2.0)
    weights: tuple[float, ...] = (8.19 / 8.45, 0.06 / 8.45, 0.2 / 8.45)

    formula = "Ψ = Σₚ 2μ wₚ/αₚ² (tr S̄^αₚ - 3) + κ/2 (J - 1)², κ = λ + 2μ/3, J = det S > 0"
    description = "Ogden rubber, α = 1.3, 5, -2 as fitted to vulcanised rubber"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.exponents) != len(self.weights) or not self.exponents:
            raise ValueError(
                f"there are {len(self.exponents)} exponents and {len(self.weights)} weights; each "
                "term needs one of both"
            )
        if not all(math.isfinite(a) and a != 0.0 for a in self.exponents):
            raise ValueError(f"the exponents are {self.exponents}; none may be 0 or infinite")
        if min(self.weights) <= 0.0 or not math.isclose(sum(self.weights), 1.0, rel_tol=1e-9):
            raise ValueError(f"the weights are {self.weights}; they must be positive, with sum 1")

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        J = ufl.det(S)
        energy = _volumetric(J, mu, lam)
        traces = traces_of_powers(S, self.exponents)
        for p, (alpha, weight) in enumerate(zip(self.exponents, self.weights, strict=True)):
            a, w = constant(S, alpha), constant(S, weight)
            trace = J ** (-a / 3) * (traces[p] + plane_strain(S))
            energy += 2 * mu * w / a**2 * (trace - 3)
        return energy
