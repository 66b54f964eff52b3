"""The displacement alone: the classical method."""

from __future__ import annotations

from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.fields import displacement_field
from forms.formulations.base import Fields, Formulation
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy
from forms.rotation import right_stretch
from forms.stress import first_piola_kirchhoff_stress


class Displacement(Formulation):
    """Ψ(S(F)): the baseline of comparisons."""

    name = "displacement"
    description = "Ψ(S(F)) in the displacement alone: the classical Newton method, the baseline"

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u at rest."""
        return (displacement_field(msh, degree),)

    def density(self, u: Expr, psi: StrainEnergy) -> Expr:
        """Ψ(S(F)) of the displacement alone: the classical method, the baseline of comparisons."""
        return psi(right_stretch(deformation_gradient(u)))

    def stretch(self, u: Expr) -> Expr:
        """Return S(F)."""
        return right_stretch(deformation_gradient(u))

    def stress(self, u: fem.Function, psi: StrainEnergy) -> Expr:
        """Return R ∂Ψ/∂S."""
        return first_piola_kirchhoff_stress(deformation_gradient(u), psi)
