"""Strain energy densities Ψ(S) of the right stretch S, isotropic, zero and stress-free at S = I.

A material is any function `psi(S) -> ufl.Expr` [J/m³]; the classes here add parameters in SI units,
range checks and a formula. Parameters enter forms as `fem.Constant`, so that a change of value does
not compile anything anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import ufl
from dolfinx import fem
from ufl.core.expr import Expr

StrainEnergy = Callable[[Expr], Expr]


def lame_parameters(E: float, nu: float) -> tuple[float, float]:
    """Return the Lamé parameters (μ, λ) [Pa] of Young's modulus E [Pa] and Poisson's ratio ν.

    Plane strain in 2D.

    Raises:
        ValueError: E is not positive and finite, or ν is outside (-1, 0.5).
    """
    if not (math.isfinite(E) and E > 0.0):
        raise ValueError(f"E is {E}; Young's modulus [Pa] must be positive and finite")
    if not -1.0 < nu < 0.5:
        raise ValueError(f"nu is {nu}; Poisson's ratio must lie between -1 and 0.5, both excluded")
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Material:
    """An isotropic material given by Young's modulus and Poisson's ratio.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].

    Raises:
        ValueError: E or nu out of range, see `lame_parameters`.
    """

    E: float
    nu: float

    formula: ClassVar[str] = ""
    description: ClassVar[str] = ""

    def __post_init__(self) -> None:
        lame_parameters(self.E, self.nu)

    @property
    def mu(self) -> float:
        """First Lamé parameter μ, the shear modulus [Pa]."""
        return lame_parameters(self.E, self.nu)[0]

    @property
    def lam(self) -> float:
        """Second Lamé parameter λ [Pa]."""
        return lame_parameters(self.E, self.nu)[1]

    def __call__(self, S: Expr) -> Expr:
        """Return Ψ(S) [J/m³] for a symmetric S of shape (d, d)."""
        domain = ufl.domain.extract_unique_domain(S)
        return self.strain_energy(S, fem.Constant(domain, self.mu), fem.Constant(domain, self.lam))

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³] with Lamé parameters [Pa] given as UFL expressions."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.formula


@dataclass(frozen=True)
class AsRigidAsPossible(Material):
    """Ψ = μ |S - I|²."""

    formula = "Ψ = μ |S - I|²"
    description = "as-rigid-as-possible; nu acts through μ only"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        strain = S - ufl.Identity(S.ufl_shape[0])
        return mu * ufl.inner(strain, strain)


@dataclass(frozen=True)
class Corotational(Material):
    """Ψ = μ |S - I|² + λ/2 tr²(S - I)."""

    formula = "Ψ = μ |S - I|² + λ/2 tr²(S - I)"
    description = "linear corotational: Hooke's law in the rotated frame"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        strain = S - ufl.Identity(S.ufl_shape[0])
        return mu * ufl.inner(strain, strain) + lam / 2 * ufl.tr(strain) ** 2


@dataclass(frozen=True)
class StableNeoHookean(Material):
    """Ψ = μ (1 - J) + λ/2 (J - 1)² + μ/2 (tr S² - d), J = det S."""

    formula = "Ψ = μ (1 - J) + λ/2 (J - 1)² + μ/2 (tr S² - d), J = det S"
    description = "stable neo-Hookean: finite at and beyond inversion"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        J = ufl.det(S)
        return mu * (1 - J) + lam / 2 * (J - 1) ** 2 + mu / 2 * (ufl.inner(S, S) - S.ufl_shape[0])


MATERIALS: dict[str, type[Material]] = {
    "as-rigid-as-possible": AsRigidAsPossible,
    "corotational": Corotational,
    "stable-neo-hookean": StableNeoHookean,
}
"""Materials by the name that a scene file uses."""
