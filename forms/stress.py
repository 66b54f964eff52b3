"""Stresses as UFL expressions, for output.

Of an isotropic material the Biot stress ∂Ψ/∂S is coaxial with S, and

    P = R ∂Ψ/∂S,   σ = P Fᵀ / J = R (∂Ψ/∂S S / J) Rᵀ.
"""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr

from forms.materials import StrainEnergy
from forms.rotation import polar_rotation, right_stretch


def biot_stress(S: Expr, psi: StrainEnergy) -> Expr:
    """Return ∂Ψ/∂S [Pa], symmetric, shape (d, d)."""
    at = ufl.variable(S)
    return ufl.sym(ufl.diff(psi(at), at))


def first_piola_kirchhoff_stress(F: Expr, psi: StrainEnergy) -> Expr:
    """Return P = R ∂Ψ/∂S at S = S(F) [Pa], shape (d, d)."""
    return polar_rotation(F) * biot_stress(right_stretch(F), psi)


def cauchy_stress(F: Expr, P: Expr) -> Expr:
    """Return σ = P Fᵀ / J [Pa], shape (d, d), of a first Piola-Kirchhoff stress P such as Λ."""
    return P * F.T / ufl.det(F)


def von_mises_stress(S: Expr, psi: StrainEnergy) -> Expr:
    """Return √(3/2) |dev σ| [Pa], which does not depend on the rotation.

    In 2D the deviator is that of plane strain: it takes the stress that Ψ of the stretch
    S ⊕ 1 gives in the third direction.

    Args:
        S: Right stretch [-], shape (d, d).
        psi: Strain energy density of symmetric tensors of shape (3, 3).
    """
    if S.ufl_shape[0] == 2:
        S = ufl.as_matrix([[S[0, 0], S[0, 1], 0], [S[1, 0], S[1, 1], 0], [0, 0, 1]])
    sigma = biot_stress(S, psi) * S / ufl.det(S)
    deviator = ufl.dev(ufl.sym(sigma))
    return ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
