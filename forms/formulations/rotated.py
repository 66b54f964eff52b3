"""Λ = R Y with Y symmetric: six multipliers for the six independent constraints S = S(F)."""

from __future__ import annotations

import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.cell_data import frozen
from forms.fields import mixed_fields
from forms.formulations.base import Fields, Formulation
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy, require_isotropic
from forms.rotation import linearised_stretch, polar_rotation


class Symmetric(Formulation):
    """Eq. (1) with Λ = R Y, Y symmetric."""

    name = "symmetric"
    description = "eq. (1) with Λ = R Y, Y symmetric: six multipliers, all independent (default)"

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Y at rest."""
        return mixed_fields(msh, degree=degree)

    def density(self, u: Expr, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
        """Eq. (1) with Λ = R Y, Y symmetric: Ψ(S) - R Y : (R S - F) = Ψ(S) - Y : S + R : F Y.

        Six multipliers for the six independent constraints S = S(F). This is the form to start
        from: every block but the displacement's is a multiple of the identity or a Hessian of Ψ.

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
            psi: Strain energy density of S.
        """
        F = deformation_gradient(u)
        R = polar_rotation(F)
        return psi(S) - ufl.inner(Y, S) + ufl.inner(R, F * Y)

    def stretch(self, u: Expr, S: Expr, Y: Expr) -> Expr:
        """Return S."""
        return S

    def stress(self, u: Expr, S: Expr, Y: Expr, psi: StrainEnergy) -> Expr:
        """Return R Y."""
        return polar_rotation(deformation_gradient(u)) * Y


class LaggedRotation(Symmetric):
    """`symmetric` with R frozen over a Newton iteration."""

    name = "lagged-rotation"
    description = "symmetric with R frozen over a Newton iteration, isotropic Ψ; Newton is linear"
    exact = False

    def density(self, u: Expr, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
        """`symmetric` with R frozen over a Newton iteration: Ψ(S) - Y : S + R̄ : F Y.

        The iteration forgets ∂R, as corotational methods do. For isotropic Ψ the terms forgotten in
        the residual vanish with S Y - Y S, so that the solutions are those of `symmetric`; for
        others they do not, and it is refused. Newton's method is linear: each iteration multiplies
        the error by the spectral radius of what the matrix lacks, relative to it, which goes to
        zero with the stress. The condensed matrix is positive definite where ∂²Ψ is. It pays for
        small stresses, where that rate is as good as quadratic.

        Collective, as Ψ is evaluated.

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
            psi: Strain energy density of S; isotropic.

        Raises:
            ValueError: On all ranks: Ψ is not isotropic.
        """
        require_isotropic(psi, S, self.name)
        F = deformation_gradient(u)
        R = frozen(polar_rotation(F))
        return psi(S) - ufl.inner(Y, S) + ufl.inner(R, F * Y)


class GaussNewton(Symmetric):
    """`symmetric` without ∂²S(F)."""

    name = "gauss-newton"
    description = "symmetric with ∂²S(F) dropped, as published: definite matrices; Newton is linear"
    exact = False

    def density(self, u: Expr, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
        """Ψ(S) - Y : (S - S̄(F)), S̄ the linearisation of S(F) at present.

        What the method's authors do: the second derivative of the constraint is dropped. Residuals
        are exact, the Newton matrix lacks Y : ∂²S. The condensed matrix M/h² + ∂Sᵀ ∂²Ψ ∂S is
        positive definite where ∂²Ψ is, whatever the stress, so that conjugate gradients need no
        guard. That is when it pays; otherwise Newton's method has become linear, at a rate that
        grows with the stress.

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
            psi: Strain energy density of S.
        """
        return psi(S) - ufl.inner(Y, S - linearised_stretch(deformation_gradient(u)))
