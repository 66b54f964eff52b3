"""The full multiplier Λ of eq. (1), as printed, regularised, or with the rotation a field."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.fields import mixed_fields, set_everywhere
from forms.formulations.base import Fields, Formulation, rest_shear_modulus
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy
from forms.points import local_space, quadrature_degree
from forms.rotation import polar_rotation, quaternion_rotation
from forms.spaces import function


class Seed(Formulation):
    """Eq. (1) as printed, made regular."""

    name = "seed"
    description = "eq. (1) as printed, full Λ, with its null space skew(RᵀΛ) held at zero"

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Λ at rest."""
        return mixed_fields(msh, multiplier="full", degree=degree)

    def density(self, u: Expr, S: fem.Function, Lam: fem.Function, psi: StrainEnergy) -> Expr:
        """Eq. (1) as printed, Ψ(S) - Λ : (R S - F), made regular by -|skew(RᵀΛ)|² / (2 G₀).

        Rᵀ(R S - F) is symmetric whatever u is, so that skew(RᵀΛ) acts on nothing and the Newton
        matrix (35) has three null vectors per tetrahedron. The added term holds skew(RᵀΛ) at zero
        and changes neither u, S nor sym(RᵀΛ). G₀ is the shear modulus of Ψ at rest.

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Lam: First Piola-Kirchhoff stress Λ [Pa], shape (d, d).
            psi: Strain energy density of S.
        """
        skew = ufl.skew(polar_rotation(deformation_gradient(u)).T * Lam)
        G0 = rest_shear_modulus(psi, S)
        return seed_singular(u, S, Lam, psi) - ufl.inner(skew, skew) / (2 * G0)

    def stretch(self, u: Expr, S: Expr, Lam: Expr) -> Expr:
        """Return S."""
        return S

    def stress(self, u: Expr, S: Expr, Lam: Expr, psi: StrainEnergy) -> Expr:
        """Return Λ."""
        return Lam


def seed_singular(u: Expr, S: fem.Function, Lam: fem.Function, psi: StrainEnergy) -> Expr:
    """Eq. (1) as printed, Ψ(S) - Λ : (R S - F); its Newton matrix (35) is singular."""
    F = deformation_gradient(u)
    R = polar_rotation(F)
    return psi(S) - ufl.inner(Lam, R * S - F)


class RotationField(Formulation):
    """Eq. (1) with the rotation an unknown."""

    name = "rotation-field"
    description = (
        "eq. (1) with R an unknown quaternion of each cell: nine multipliers, all independent"
    )

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Λ, q at rest."""
        u, S, Lam = mixed_fields(msh, multiplier="full", degree=degree)
        size = {2: 2, 3: 4}[len(u)]
        q = function(local_space(msh, quadrature_degree(u.function_space), (size,)), name="q")
        set_everywhere(q, np.eye(size)[0])
        return u, S, Lam, q

    def density(
        self, u: Expr, S: fem.Function, Lam: fem.Function, q: fem.Function, psi: StrainEnergy
    ) -> Expr:
        """Ψ(S) - Λ : (R(q) S - F) - G₀/4 (|q|² - 1)²: the rotation is an unknown of its own.

        R(q) is the rotation of a quaternion q of any length, in 2D of a complex number. Now all
        nine multipliers are independent: ∂L/∂R = 0 makes RᵀΛ symmetric where the seed's form has a
        null space. The last term fixes the length of q, on which nothing else depends; G₀ is the
        shear modulus of Ψ at rest. There is no polar decomposition: UFL's derivatives are exact to
        every order, and nothing is singular where σ₂ + σ₃ = 0. It pays where third derivatives are
        wanted, and as a check on the polar rotation. It costs 19 local unknowns a tetrahedron in
        place of 12, and fails first as time steps grow, since q follows F only to first order.

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d).
            Lam: First Piola-Kirchhoff stress Λ [Pa], shape (d, d).
            q: Quaternion [-], shape (4,), or complex number, shape (2,).
            psi: Strain energy density of S.
        """
        excess = ufl.inner(q, q) - 1
        constraint = ufl.inner(Lam, quaternion_rotation(q) * S - deformation_gradient(u))
        return psi(S) - constraint - rest_shear_modulus(psi, S) / 4 * excess**2

    def stretch(self, u: Expr, S: Expr, Lam: Expr, q: Expr) -> Expr:
        """Return S."""
        return S

    def stress(self, u: Expr, S: Expr, Lam: Expr, q: Expr, psi: StrainEnergy) -> Expr:
        """Return Λ."""
        return Lam
