"""The change of volume as a field: no locking as ν comes near 1/2."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.cell_data import intermediate
from forms.fields import mixed_fields, set_everywhere
from forms.formulations.base import Fields, Formulation
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy
from forms.points import is_simplicial, local_space, quadrature_degree
from forms.rotation import polar_rotation, right_stretch
from forms.spaces import function, function_space


class MeanDilatation(Formulation):
    """`symmetric` with a change of volume of few values a cell."""

    name = "mean-dilatation"
    description = "symmetric with the change of volume θ and a pressure p as fields: no locking"
    equivalent = False

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Y, θ, p at rest."""
        u, S, Y = mixed_fields(msh, degree=degree)
        if is_simplicial(msh):
            V = function_space(msh, ("DG", max(degree - 2, 0)))
        else:
            V = function_space(msh, ("DPC", degree - 1))
        theta, p = function(V, name="theta"), function(V, name="p")
        theta.interpolate(lambda X: np.ones(X.shape[1]))
        return u, S, Y, theta, p

    def density(
        self,
        u: Expr,
        S: fem.Function,
        Y: fem.Function,
        theta: fem.Function,
        p: fem.Function,
        psi: StrainEnergy,
    ) -> Expr:
        """Ψ((θ/det S)^(1/d) S) - Y : (S - S(F)) + p (det F - θ): `symmetric` without locking.

        As ν goes to 1/2 the volume of each quadrature point is held, more constraints than a mesh
        has displacements, and it stiffens: it locks. Here the change of volume is a field θ of few
        values a cell, the only one that Ψ sees, with a pressure p. θ and p are constant on Q1 and
        P2 cells and linear on Q2 and P3 cells. With Q1, Q2 and P3 that cures; P2 becomes as much
        too soft as it was too stiff, and on P2 and P3 the positions lose an order. On P1 simplices
        θ is det F, and it is `symmetric`, locking included. θ and p are local to cells: static
        condensation takes them along.

        J. C. Simo, R. L. Taylor, K. S. Pister, Variational and projection methods for the volume
        constraint in finite deformation elasto-plasticity, CMAME 51 (1985).

        Args:
            u: Displacement [m], shape (d,).
            S: Right stretch [-], symmetric, shape (d, d); its determinant does not enter Ψ.
            Y: Rotated stress [Pa], symmetric, shape (d, d), without the part of p.
            theta: Change of volume θ [-].
            p: Pressure [Pa], positive in tension.
            psi: Strain energy density of S.
        """
        F = deformation_gradient(u)
        volume = p * (ufl.det(F) - theta)
        return psi(_dilated(S, theta)) - ufl.inner(Y, S - right_stretch(F)) + volume

    def stretch(self, u: Expr, S: Expr, Y: Expr, theta: Expr, p: Expr) -> Expr:
        """Return (θ/det S)^(1/d) S."""
        return _dilated(S, theta)

    def stress(self, u: Expr, S: Expr, Y: Expr, theta: Expr, p: Expr, psi: StrainEnergy) -> Expr:
        """Return R Y + p J F⁻ᵀ."""
        F = deformation_gradient(u)
        return polar_rotation(F) * Y + p * ufl.det(F) * ufl.inv(F).T


class TaylorHood(MeanDilatation):
    """The Lagrangian of `mean-dilatation` with a continuous pressure.

    The displacement has one degree more than the pressure, and θ is a value at each point where S
    lives: Ψ((θ/det S)^(1/d) S) - Y : (S - S(F)) + p (det F - θ). Eliminating S, Y and θ at each
    point leaves displacement and pressure in Taylor and Hood's pair, P2/P1 at its lowest, which is
    stable: it does not lock as ν goes to 1/2, on triangles and tetrahedra, either, and converges
    with the orders k + 2 of u and k + 1 of p. It takes any Ψ, since θ is a field of its own; where
    Ψ is not split into parts, p is ∂Ψ/∂θ.

    The pressure couples cells, so that its dofs are unknowns of the global system, beside the
    displacement's.

    C. Taylor, P. Hood, A numerical solution of the Navier-Stokes equations using the finite element
    technique, Computers & Fluids 1 (1973).
    """

    name = "taylor-hood"
    description = "as mean-dilatation, p continuous, u of degree + 1: no locking on simplices"

    def degree_of_u(self, degree: int) -> int:
        """Return the degree of the displacement for that of the pressure."""
        return degree + 1

    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return u, S, Y, θ, p at rest.

        Args:
            msh: Triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D.
            degree: Of the pressure; the displacement has degree + 1.
        """
        if degree < 1:
            raise ValueError(f"degree is {degree}; a continuous pressure has degree 1 or more")
        u, S, Y = mixed_fields(msh, degree=self.degree_of_u(degree))
        points = local_space(msh, quadrature_degree(u.function_space))
        theta = function(points, name="theta")
        set_everywhere(theta, 1.0)
        return u, S, Y, theta, function(function_space(msh, ("P", degree)), name="p")


def _dilated(S: Expr, theta: Expr) -> Expr:
    """The stretch that Ψ is given: S with the determinant θ."""
    return intermediate((theta / ufl.det(S)) ** (1 / S.ufl_shape[0]) * S)
