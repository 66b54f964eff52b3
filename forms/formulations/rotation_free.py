"""Constraints on a strain that needs no rotation: the square or the logarithm of the stretch."""

from __future__ import annotations

import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms import spectral
from forms.fields import mixed_fields
from forms.formulations.base import Fields, Formulation
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy


class HuWashizu(Formulation):
    """Three fields without any rotation."""

    name = "hu-washizu"
    description = (
        "Ψ(S) - ½ Σ : (S² - FᵀF): no rotation at all; Σ is the second Piola-Kirchhoff stress"
    )
    sees_inversion = False

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Σ at rest."""
        u, S, Sigma = mixed_fields(msh, degree=degree)
        Sigma.name = "Sigma"
        return u, S, Sigma

    def density(self, u: Expr, S: fem.Function, Sigma: fem.Function, psi: StrainEnergy) -> Expr:
        """Ψ(S) - ½ Σ : (S² - FᵀF): three fields without any rotation, after Hu and Washizu.

        S = S(F) needs a rotation, its square S² = FᵀF does not; the multiplier is then the second
        Piola-Kirchhoff stress Σ, with P = F Σ and ∂Ψ/∂S = sym(S Σ). Polynomial in the kinematics,
        it compiles fast, needs no per-cell data and is exact to every order. It pays for small
        steps, and as a route that shares nothing with the polar decomposition. The constraint is
        quadratic in F, which costs Newton iterations in large steps. det F < 0 costs nothing.

        H. Hu, On some variational principles in the theory of elasticity and plasticity, Scientia
        Sinica 4 (1955); K. Washizu, MIT report (1955).

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Sigma: Second Piola-Kirchhoff stress Σ [Pa], symmetric, shape (d, d).
            psi: Strain energy density of S.
        """
        F = deformation_gradient(u)
        return psi(S) - ufl.inner(Sigma, S * S - F.T * F) / 2

    def stretch(self, u: Expr, S: Expr, Sigma: Expr) -> Expr:
        """Return S."""
        return S

    def stress(self, u: Expr, S: Expr, Sigma: Expr, psi: StrainEnergy) -> Expr:
        """Return F Σ."""
        return deformation_gradient(u) * Sigma


class LogStrain(Formulation):
    """The strain is Hencky's."""

    name = "log-strain"
    description = "Ψ(exp H) - T : (H - ½ log FᵀF): S = exp H is positive definite whatever H"
    sees_inversion = False

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, H, T at rest."""
        u, H, T = mixed_fields(msh, degree=degree)
        H.name, T.name = "H", "T"
        H.x.array[:] = 0.0
        return u, H, T

    def density(self, u: Expr, H: fem.Function, T: fem.Function, psi: StrainEnergy) -> Expr:
        """Ψ(exp H) - T : (H - ½ log FᵀF): the strain is Hencky's, S = exp H.

        S is positive definite whatever Newton's method makes of H, so that Ψ with a logarithm or a
        negative power in it always has a value: no iterate falls out of its domain, which costs the
        other mixed forms their full steps. tr H = ln J is linear. Those are the materials for which
        it pays. T is the stress conjugate to H, σ rotated back times J. As in `hu_washizu` there is
        no rotation, and det F < 0 costs nothing; functions of tensors cost eigenvalues cell by
        cell (`forms.spectral`).

        Args:
            u: Displacement [m], shape (d,).
            H: Logarithmic strain [-], symmetric, shape (d, d).
            T: Stress conjugate to H [Pa], symmetric, shape (d, d).
            psi: Strain energy density of S.
        """
        return psi(spectral.exp(H)) - ufl.inner(T, H - _hencky_strain(deformation_gradient(u)))

    def stretch(self, u: Expr, H: Expr, T: Expr) -> Expr:
        """Return exp H."""
        return spectral.exp(H)

    def stress(self, u: Expr, H: Expr, T: Expr, psi: StrainEnergy) -> Expr:
        """Return ∂/∂F T : ½ log FᵀF."""
        F = ufl.variable(deformation_gradient(u))
        return ufl.diff(ufl.inner(T, _hencky_strain(F)), F)


def _hencky_strain(F: Expr) -> Expr:
    return spectral.log(F.T * F) / 2
