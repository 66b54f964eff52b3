"""Mixed Lagrangians: short functions from fields to an energy density [J/m³] (seed, eq. 1).

Each leaves out the kinetic term, which a time scheme adds (`forms.time`). Λ is the first
Piola-Kirchhoff stress at a stationary point: ∂L/∂S = 0 reads ∂Ψ/∂S = sym(RᵀΛ).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.algorithms import expand_derivatives
from ufl.core.expr import Expr

from forms.fields import displacement_field, mixed_fields
from forms.kernels import DisplacementKernel, SymmetricKernel
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy
from forms.rotation import polar_rotation, right_stretch
from forms.stress import first_piola_kirchhoff_stress

Fields = tuple[fem.Function, ...]


def symmetric(u: fem.Function, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
    """Eq. (1) with Λ = R Y, Y symmetric: Ψ(S) - R Y : (R S - F) = Ψ(S) - Y : S + R : F Y.

    Six multipliers for the six independent constraints S = S(F). This is the form to start from:
    every block but the displacement's is a multiple of the identity or a Hessian of Ψ.

    Args:
        u: Displacement [m], shape (d,).
        S: Right stretch [-], symmetric, shape (d, d).
        Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
        psi: Strain energy density of S.
    """
    R, F = polar_rotation(u), deformation_gradient(u)
    return psi(S) - ufl.inner(Y, S) + ufl.inner(R, F * Y)


def seed(u: fem.Function, S: fem.Function, Lam: fem.Function, psi: StrainEnergy) -> Expr:
    """Eq. (1) as printed, Ψ(S) - Λ : (R S - F), made regular by -|skew(RᵀΛ)|² / (2 G₀).

    Rᵀ(R S - F) is symmetric whatever u is, so that skew(RᵀΛ) acts on nothing and the Newton matrix
    (35) has three null vectors per tetrahedron. The added term holds skew(RᵀΛ) at zero and changes
    neither u, S nor sym(RᵀΛ). G₀ is the shear modulus of Ψ at rest.

    Args:
        u: Displacement [m], shape (d,).
        S: Right stretch [-], symmetric, shape (d, d).
        Lam: First Piola-Kirchhoff stress Λ [Pa], shape (d, d).
        psi: Strain energy density of S.
    """
    skew = ufl.skew(polar_rotation(u).T * Lam)
    return seed_singular(u, S, Lam, psi) - ufl.inner(skew, skew) / (2 * _rest_shear_modulus(psi, S))


def seed_singular(u: fem.Function, S: fem.Function, Lam: fem.Function, psi: StrainEnergy) -> Expr:
    """Eq. (1) as printed, Ψ(S) - Λ : (R S - F); its Newton matrix (35) is singular."""
    R, F = polar_rotation(u), deformation_gradient(u)
    return psi(S) - ufl.inner(Lam, R * S - F)


def displacement(u: fem.Function, psi: StrainEnergy) -> Expr:
    """Ψ(S(F)) of the displacement alone: the classical method, the baseline of comparisons."""
    return psi(right_stretch(u))


def _rest_shear_modulus(psi: StrainEnergy, S: fem.Function) -> Expr:
    """∂²Ψ/∂S₀₁² at S = I [Pa], with S₀₁ and S₁₀ varied independently."""
    d = S.ufl_shape[0]
    rest = fem.Function(S.function_space)
    rest.interpolate(lambda X: np.tile(np.eye(d).reshape(-1, 1), X.shape[1]))
    at = ufl.variable(rest)
    tangent = ufl.diff(ufl.diff(psi(at), at), at)[0, 1, 0, 1]
    return ufl.replace(expand_derivatives(tangent), {rest: ufl.Identity(d)})


@dataclass(frozen=True)
class Formulation:
    """A named formulation and how to read its fields.

    Attributes:
        name: The name that a scene file uses.
        description: One line.
        fields: Function from a mesh to the unknowns at rest, the displacement first.
        density: Function from (*fields, psi) to the energy density [J/m³] without inertia.
        stretch: Function from the fields to the right stretch S, shape (d, d).
        multiplier: Function from (*fields, psi) to the first Piola-Kirchhoff stress Λ [Pa],
            shape (d, d).
        kernel: Function from (*fields, psi) to a compiled kernel of the density with `psi` a
            built-in material, or None where there is no such kernel.
    """

    name: str
    description: str
    fields: Callable[[mesh.Mesh], Fields]
    density: Callable[..., Expr]
    stretch: Callable[..., Expr]
    multiplier: Callable[..., Expr]
    kernel: Callable[..., SymmetricKernel | DisplacementKernel] | None = None


FORMULATIONS: dict[str, Formulation] = {
    formulation.name: formulation
    for formulation in (
        Formulation(
            "symmetric",
            "eq. (1) with Λ = R Y, Y symmetric: six multipliers, all independent (default)",
            fields=mixed_fields,
            density=symmetric,
            stretch=lambda u, S, Y: S,
            multiplier=lambda u, S, Y, psi: polar_rotation(u) * Y,
            kernel=SymmetricKernel,
        ),
        Formulation(
            "seed",
            "eq. (1) as printed, full Λ, with its null space skew(RᵀΛ) held at zero",
            fields=lambda msh: mixed_fields(msh, multiplier="full"),
            density=seed,
            stretch=lambda u, S, Lam: S,
            multiplier=lambda u, S, Lam, psi: Lam,
        ),
        Formulation(
            "displacement",
            "Ψ(S(F)) in the displacement alone: the classical Newton method, the baseline",
            fields=lambda msh: (displacement_field(msh),),
            density=displacement,
            stretch=right_stretch,
            multiplier=first_piola_kirchhoff_stress,
            kernel=DisplacementKernel,
        ),
    )
}
"""Formulations by name."""
