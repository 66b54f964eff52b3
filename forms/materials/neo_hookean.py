"""Neo-Hookean materials: linear in tr S², and a function of J = det S."""

from __future__ import annotations

from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from forms.materials.base import Material


@dataclass(frozen=True)
class StableNeoHookean(Material):
    """Ψ = μ (1 - J) + λ/2 (J - 1)² + μ/2 (tr S² - d), J = det S.

    The form that the method's authors use, with the Lamé parameters of E and ν as they are. Small
    strains then obey Hooke's law with λ - μ in place of λ; `SmithNeoHookean` corrects that.
    """

    formula = "Ψ = μ (1 - J) + λ/2 (J - 1)² + μ/2 (tr S² - d), J = det S"
    description = "stable neo-Hookean: finite at and beyond inversion"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        J = ufl.det(S)
        return mu * (1 - J) + lam / 2 * (J - 1) ** 2 + mu / 2 * (ufl.inner(S, S) - S.ufl_shape[0])

    @property
    def rest(self) -> tuple[float, float]:
        """(μ, λ - μ)."""
        return self.mu, self.lam - self.mu


@dataclass(frozen=True)
class SmithNeoHookean(StableNeoHookean):
    """Ψ = μ (1 - J) + (λ + μ)/2 (J - 1)² + μ/2 (tr S² - d), J = det S.

    Stable neo-Hookean with its parameters shifted so that small strains obey Hooke's law.

    B. Smith, F. de Goes, T. Kim, Stable neo-Hookean flesh simulation, ACM TOG 37 (2018), sec. 3.4.
    """

    formula = "Ψ = μ (1 - J) + (λ + μ)/2 (J - 1)² + μ/2 (tr S² - d), J = det S"
    description = "stable neo-Hookean with Hooke's law of E and nu at small strains"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        return super().strain_energy(S, mu, lam + mu)

    @property
    def rest(self) -> tuple[float, float]:
        """(μ, λ)."""
        return self.mu, self.lam


@dataclass(frozen=True)
class NeoHookean(Material):
    """Ψ = μ/2 (tr S² - d) - μ ln J + λ/2 ln² J, J = det S > 0.

    J. C. Simo, K. S. Pister, Remarks on rate constitutive equations for finite deformation
    problems, CMAME 46 (1984).
    """

    formula = "Ψ = μ/2 (tr S² - d) - μ ln J + λ/2 ln² J, J = det S > 0"
    description = "compressible neo-Hookean: infinite at collapse, undefined beyond"

    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³]."""
        log_J = ufl.ln(ufl.det(S))
        return mu / 2 * (ufl.inner(S, S) - S.ufl_shape[0]) - mu * log_J + lam / 2 * log_J**2
