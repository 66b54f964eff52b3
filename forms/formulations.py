"""Mixed Lagrangians: short functions from fields to an energy density [J/m³] (seed, eq. 1).

Each leaves out the kinetic term, which a time scheme adds (`forms.time`). Λ is the first
Piola-Kirchhoff stress at a stationary point: ∂L/∂S = 0 reads ∂Ψ/∂S = sym(RᵀΛ). With the same rule
of integration (`forms.points`) all but `mean_dilatation` have the positions of `displacement`; what
differs is the way of Newton's method there, and what an iteration costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms import spectral
from forms.cell_data import frozen
from forms.fields import displacement_field, mixed_fields, set_everywhere
from forms.kernels import DisplacementKernel, SymmetricKernel
from forms.kinematics import deformation_gradient
from forms.materials import StrainEnergy
from forms.points import is_simplicial, local_space, quadrature_degree
from forms.rotation import (
    linearised_stretch,
    polar_rotation,
    quaternion_rotation,
    right_stretch,
)
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


def rotation_field(
    u: fem.Function, S: fem.Function, Lam: fem.Function, q: fem.Function, psi: StrainEnergy
) -> Expr:
    """Ψ(S) - Λ : (R(q) S - F) - G₀/4 (|q|² - 1)²: the rotation is an unknown of its own.

    R(q) is the rotation of a quaternion q of any length, in 2D of a complex number. Now all nine
    multipliers are independent: ∂L/∂R = 0 makes RᵀΛ symmetric where the seed's form has a null
    space. The last term fixes the length of q, on which nothing else depends; G₀ is the shear
    modulus of Ψ at rest. There is no polar decomposition: UFL's derivatives are exact to every
    order, and nothing is singular where σ₂ + σ₃ = 0. It pays where third derivatives are wanted,
    and as a check on the polar rotation. It costs 19 local unknowns a tetrahedron in place of 12,
    and fails first as time steps grow, since q follows F only to first order.

    Args:
        u: Displacement [m], shape (d,).
        S: Right stretch [-], symmetric, shape (d, d).
        Lam: First Piola-Kirchhoff stress Λ [Pa], shape (d, d).
        q: Quaternion [-], shape (4,), or complex number, shape (2,).
        psi: Strain energy density of S.
    """
    excess = ufl.inner(q, q) - 1
    constraint = ufl.inner(Lam, quaternion_rotation(q) * S - deformation_gradient(u))
    return psi(S) - constraint - _rest_shear_modulus(psi, S) / 4 * excess**2


def lagged_rotation(u: fem.Function, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
    """`symmetric` with R frozen over a Newton iteration: Ψ(S) - Y : S + R̄ : F Y.

    The iteration forgets ∂R, as corotational methods do. For isotropic Ψ the terms forgotten in the
    residual vanish with S Y - Y S, so that the solutions are those of `symmetric`. Newton's method
    is linear: each iteration multiplies the error by the spectral radius of what the matrix lacks,
    relative to it, which goes to zero with the stress. The condensed matrix is positive definite
    where ∂²Ψ is. It pays for small stresses, where that rate is as good as quadratic.

    Args:
        u: Displacement [m], shape (d,).
        S: Right stretch [-], symmetric, shape (d, d).
        Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
        psi: Strain energy density of S; isotropic.
    """
    R, F = frozen(polar_rotation(u)), deformation_gradient(u)
    return psi(S) - ufl.inner(Y, S) + ufl.inner(R, F * Y)


def gauss_newton(u: fem.Function, S: fem.Function, Y: fem.Function, psi: StrainEnergy) -> Expr:
    """`symmetric` without ∂²S(F): Ψ(S) - Y : (S - S̄(F)), S̄ the linearisation of S(F) at present.

    What the method's authors do: the second derivative of the constraint is dropped. Residuals are
    exact, the Newton matrix lacks Y : ∂²S. The condensed matrix M/h² + ∂Sᵀ ∂²Ψ ∂S is positive
    definite where ∂²Ψ is, whatever the stress, so that conjugate gradients need no guard. That is
    when it pays; otherwise Newton's method has become linear, at a rate that grows with the stress.

    Args:
        u: Displacement [m], shape (d,).
        S: Right stretch [-], symmetric, shape (d, d).
        Y: Rotated first Piola-Kirchhoff stress RᵀΛ [Pa], symmetric, shape (d, d).
        psi: Strain energy density of S.
    """
    return psi(S) - ufl.inner(Y, S - linearised_stretch(u))


def hu_washizu(u: fem.Function, S: fem.Function, Sigma: fem.Function, psi: StrainEnergy) -> Expr:
    """Ψ(S) - ½ Σ : (S² - FᵀF): three fields without any rotation, after Hu and Washizu.

    S = S(F) needs a rotation, its square S² = FᵀF does not; the multiplier is then the second
    Piola-Kirchhoff stress Σ, with P = F Σ and ∂Ψ/∂S = sym(S Σ). Polynomial in the kinematics, it
    compiles fast, needs no per-cell data and is exact to every order. It pays for small steps,
    and as a route that shares nothing with the polar decomposition. The constraint is quadratic in
    F, which costs Newton iterations in large steps. det F < 0 goes unnoticed.

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


def log_strain(u: fem.Function, H: fem.Function, T: fem.Function, psi: StrainEnergy) -> Expr:
    """Ψ(exp H) - T : (H - ½ log FᵀF): the strain is Hencky's, S = exp H.

    S is positive definite whatever Newton's method makes of H, so that Ψ with a logarithm or a
    negative power in it always has a value: no iterate falls out of its domain, which costs the
    other mixed forms their full steps. tr H = ln J is linear. Those are the materials for which it
    pays. T is the stress conjugate to H, σ rotated back times J. As in `hu_washizu` there is no
    rotation, and det F < 0 goes unnoticed; functions of tensors cost eigenvalues cell by cell
    (`forms.spectral`).

    Args:
        u: Displacement [m], shape (d,).
        H: Logarithmic strain [-], symmetric, shape (d, d).
        T: Stress conjugate to H [Pa], symmetric, shape (d, d).
        psi: Strain energy density of S.
    """
    return psi(spectral.exp(H)) - ufl.inner(T, H - _hencky_strain(deformation_gradient(u)))


def mean_dilatation(
    u: fem.Function,
    S: fem.Function,
    Y: fem.Function,
    theta: fem.Function,
    p: fem.Function,
    psi: StrainEnergy,
) -> Expr:
    """Ψ((θ/det S)^(1/d) S) - Y : (S - S(F)) + p (det F - θ): `symmetric` without locking.

    As ν goes to 1/2 the volume of each quadrature point is held, more constraints than a mesh has
    displacements, and it stiffens: it locks. Here the change of volume is a field θ of few values a
    cell, the only one that Ψ sees, with a pressure p. θ and p are constant on Q1 and P2 cells and
    linear on Q2 and P3 cells. With Q1, Q2 and P3 that cures; P2 becomes as much too soft as it was
    too stiff, and on P2 and P3 the positions lose an order. On P1 simplices θ is det F, and it is
    `symmetric`, locking included. θ and p are local to cells: static condensation takes them along.

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
    volume = p * (ufl.det(deformation_gradient(u)) - theta)
    return psi(_dilated(S, theta)) - ufl.inner(Y, S - right_stretch(u)) + volume


def _dilated(S: Expr, theta: Expr) -> Expr:
    """The stretch that `mean_dilatation` gives to Ψ: S with the determinant θ."""
    return (theta / ufl.det(S)) ** (1 / S.ufl_shape[0]) * S


def _hencky_strain(F: Expr) -> Expr:
    return spectral.log(F.T * F) / 2


def _stress_of_log_strain(u: fem.Function, T: fem.Function) -> Expr:
    """P = ∂/∂F T : ½ log FᵀF."""
    F = ufl.variable(deformation_gradient(u))
    return ufl.diff(ufl.inner(T, _hencky_strain(F)), F)


def _stress_of_mean_dilatation(
    u: fem.Function,
    S: fem.Function,
    Y: fem.Function,
    theta: fem.Function,
    p: fem.Function,
    psi: StrainEnergy,
) -> Expr:
    """P = R Y + p J F⁻ᵀ."""
    F = deformation_gradient(u)
    return polar_rotation(u) * Y + p * ufl.det(F) * ufl.inv(F).T


def _displacement_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    return (displacement_field(msh, degree),)


def _symmetric_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    return mixed_fields(msh, degree=degree)


def _seed_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    return mixed_fields(msh, multiplier="full", degree=degree)


def _rotation_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    u, S, Lam = mixed_fields(msh, multiplier="full", degree=degree)
    size = {2: 2, 3: 4}[len(u)]
    q = fem.Function(local_space(msh, quadrature_degree(u.function_space), (size,)), name="q")
    set_everywhere(q, np.eye(size)[0])
    return u, S, Lam, q


def _log_strain_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    u, H, T = mixed_fields(msh, degree=degree)
    H.name, T.name = "H", "T"
    H.x.array[:] = 0.0
    return u, H, T


def _hu_washizu_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    u, S, Sigma = mixed_fields(msh, degree=degree)
    Sigma.name = "Sigma"
    return u, S, Sigma


def _mean_dilatation_fields(msh: mesh.Mesh, degree: int = 1) -> Fields:
    u, S, Y = mixed_fields(msh, degree=degree)
    if is_simplicial(msh):
        V = fem.functionspace(msh, ("DG", max(degree - 2, 0)))
    else:
        V = fem.functionspace(msh, ("DPC", degree - 1))
    theta, p = fem.Function(V, name="theta"), fem.Function(V, name="p")
    theta.interpolate(lambda X: np.ones(X.shape[1]))
    return u, S, Y, theta, p


def displacement(u: fem.Function, psi: StrainEnergy) -> Expr:
    """Ψ(S(F)) of the displacement alone: the classical method, the baseline of comparisons."""
    return psi(right_stretch(u))


def _rest_shear_modulus(psi: StrainEnergy, S: fem.Function) -> Expr:
    """¼ ∂²Ψ[D, D] [Pa] at S = I on each cell, D the shear D₀₁ = D₁₀ = 1."""
    rest, shear = fem.Function(S.function_space), fem.Function(S.function_space)
    D = np.zeros(S.ufl_shape)
    D[0, 1] = D[1, 0] = 1.0
    set_everywhere(rest, np.eye(len(D)))
    set_everywhere(shear, D)
    twice = ufl.derivative(ufl.derivative(psi(rest), rest, shear), rest, shear)
    return frozen(twice / 4, S.function_space.mesh)


@dataclass(frozen=True)
class Formulation:
    """A named formulation and how to read its fields.

    Attributes:
        name: The name that a scene file uses.
        description: One line.
        fields: Function from a mesh and the degree of the displacement, 1 by default, to the
            unknowns at rest, the displacement first.
        density: Function from (*fields, psi) to the energy density [J/m³] without inertia.
        stretch: Function from the fields to the right stretch that Ψ is a function of, shape
            (d, d).
        multiplier: Function from (*fields, psi) to the first Piola-Kirchhoff stress Λ [Pa],
            shape (d, d).
        kernel: Function from (*fields, psi) to a compiled kernel of the density with `psi` a
            built-in material, or None where there is no such kernel.
        exact: Whether UFL's Newton matrix is the derivative of the residual. If not, Newton's
            method converges linearly.
    """

    name: str
    description: str
    fields: Callable[..., Fields]
    density: Callable[..., Expr]
    stretch: Callable[..., Expr]
    multiplier: Callable[..., Expr]
    kernel: Callable[..., SymmetricKernel | DisplacementKernel] | None = None
    exact: bool = True


FORMULATIONS: dict[str, Formulation] = {
    formulation.name: formulation
    for formulation in (
        Formulation(
            "symmetric",
            "eq. (1) with Λ = R Y, Y symmetric: six multipliers, all independent (default)",
            fields=_symmetric_fields,
            density=symmetric,
            stretch=lambda u, S, Y: S,
            multiplier=lambda u, S, Y, psi: polar_rotation(u) * Y,
            kernel=SymmetricKernel,
        ),
        Formulation(
            "seed",
            "eq. (1) as printed, full Λ, with its null space skew(RᵀΛ) held at zero",
            fields=_seed_fields,
            density=seed,
            stretch=lambda u, S, Lam: S,
            multiplier=lambda u, S, Lam, psi: Lam,
        ),
        Formulation(
            "rotation-field",
            "eq. (1) with R an unknown quaternion of each cell: nine multipliers, all independent",
            fields=_rotation_fields,
            density=rotation_field,
            stretch=lambda u, S, Lam, q: S,
            multiplier=lambda u, S, Lam, q, psi: Lam,
        ),
        Formulation(
            "lagged-rotation",
            "symmetric with R frozen over a Newton iteration; Newton is linear",
            fields=_symmetric_fields,
            density=lagged_rotation,
            stretch=lambda u, S, Y: S,
            multiplier=lambda u, S, Y, psi: polar_rotation(u) * Y,
            exact=False,
        ),
        Formulation(
            "gauss-newton",
            "symmetric with ∂²S(F) dropped, as published: definite matrices; Newton is linear",
            fields=_symmetric_fields,
            density=gauss_newton,
            stretch=lambda u, S, Y: S,
            multiplier=lambda u, S, Y, psi: polar_rotation(u) * Y,
            exact=False,
        ),
        Formulation(
            "hu-washizu",
            "Ψ(S) - ½ Σ : (S² - FᵀF): no rotation at all; Σ is the second Piola-Kirchhoff stress",
            fields=_hu_washizu_fields,
            density=hu_washizu,
            stretch=lambda u, S, Sigma: S,
            multiplier=lambda u, S, Sigma, psi: deformation_gradient(u) * Sigma,
        ),
        Formulation(
            "log-strain",
            "Ψ(exp H) - T : (H - ½ log FᵀF): S = exp H is positive definite whatever H",
            fields=_log_strain_fields,
            density=log_strain,
            stretch=lambda u, H, T: spectral.exp(H),
            multiplier=lambda u, H, T, psi: _stress_of_log_strain(u, T),
        ),
        Formulation(
            "mean-dilatation",
            "symmetric with the change of volume θ and a pressure p as fields: no locking",
            fields=_mean_dilatation_fields,
            density=mean_dilatation,
            stretch=lambda u, S, Y, theta, p: _dilated(S, theta),
            multiplier=_stress_of_mean_dilatation,
        ),
        Formulation(
            "displacement",
            "Ψ(S(F)) in the displacement alone: the classical Newton method, the baseline",
            fields=_displacement_fields,
            density=displacement,
            stretch=right_stretch,
            multiplier=first_piola_kirchhoff_stress,
            kernel=DisplacementKernel,
        ),
    )
}
"""Formulations by name."""
