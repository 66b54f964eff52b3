"""Materials in the stretch itself: quadratic, or nearly so, in S - I."""

from __future__ import annotations

from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from forms.materials.base import Material


@dataclass(frozen=True)
class AsRigidAsPossible(Material):
    """Ψ = μ |S - I|²."""

    formula = "Ψ = μ |S - I|²"
    description = "as-rigid-as-possible; nu acts through μ only"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        strain = S - ufl.Identity(S.ufl_shape[0])
        return mu * ufl.inner(strain, strain)

    @property
    def rest(self) -> tuple[float, float]:
        """(μ, 0): Hooke's law without the term in λ."""
        return self.mu, 0.0


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
class FixedCorotational(Material):
    """Ψ = μ |S - I|² + λ/2 (J - 1)², J = det S.

    A. Stomakhin, R. Howes, C. Schroeder, J. Teran, Energetically consistent invertible elasticity,
    SCA 2012.
    """

    formula = "Ψ = μ |S - I|² + λ/2 (J - 1)², J = det S"
    description = "corotational with the change of volume in place of its linearisation"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        strain = S - ufl.Identity(S.ufl_shape[0])
        return mu * ufl.inner(strain, strain) + lam / 2 * (ufl.det(S) - 1) ** 2
