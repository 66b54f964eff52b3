"""Materials in a strain other than S - I: Green's (S² - I)/2, Hencky's log S."""

from __future__ import annotations

import math
from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from forms.materials.base import Material, constant
from forms.spectral import log


def _green(S: Expr) -> Expr:
    return (S * S - ufl.Identity(S.ufl_shape[0])) / 2


@dataclass(frozen=True)
class StVenantKirchhoff(Material):
    """Ψ = μ |G|² + λ/2 tr² G, G = (S² - I)/2."""

    formula = "Ψ = μ |G|² + λ/2 tr² G, G = (S² - I)/2"
    description = "St. Venant-Kirchhoff: Hooke's law in Green's strain; softens in compression"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        G = _green(S)
        return mu * ufl.inner(G, G) + lam / 2 * ufl.tr(G) ** 2


@dataclass(frozen=True)
class Hencky(Material):
    """Ψ = μ |log S|² + λ/2 ln² J, J = det S, S positive definite.

    H. Hencky, Über die Form des Elastizitätsgesetzes bei ideal elastischen Stoffen, Z. techn. Phys.
    9 (1928). Convex in log S; not rank-one convex beyond stretches of about 1.4.
    """

    formula = "Ψ = μ |log S|² + λ/2 tr² log S"
    description = "Hencky: Hooke's law in logarithmic strain, the same in tension and compression"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        H = log(S)
        return mu * ufl.inner(H, H) + lam / 2 * ufl.tr(H) ** 2


@dataclass(frozen=True)
class Fung(Material):
    """Ψ = μ/(2b) (exp(b Q) - 1), Q = 2 |G|² + λ/μ tr² G, G = (S² - I)/2.

    Y. C. Fung, Elasticity of soft tissues in simple elongation, Am. J. Physiol. 213 (1967).

    Attributes:
        b: Rate of stiffening [-], positive; strains beyond about b^(-1/2) are stiff.

    Raises:
        ValueError: E, nu or b out of range.
    """

    b: float = 1.0

    formula = "Ψ = μ/(2b) (exp(b Q) - 1), Q = 2 |G|² + λ/μ tr² G, G = (S² - I)/2"
    description = "Fung's exponential law of soft tissue, b = 1: stiffens with strain"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.b) and self.b > 0.0):
            raise ValueError(f"b is {self.b}; the rate of stiffening must be positive and finite")

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        G, b = _green(S), constant(S, self.b)
        Q = 2 * ufl.inner(G, G) + lam / mu * ufl.tr(G) ** 2
        return mu / (2 * b) * (ufl.exp(b * Q) - 1)
