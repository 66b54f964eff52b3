r"""The polar rotation R(F) as a custom per-cell expression that UFL can differentiate twice.

F = R S with R in SO(3) and S symmetric is found cell by cell through a singular value decomposition
(seed, eq. 14), which UFL cannot see through. So the SVD only supplies numbers, R₀ = R(F₀),
S₀ = S(F₀) at the current F₀, and the UFL expression is the exact second-order Taylor polynomial of
R around F₀ in terms of them. At F = F₀, where a solver evaluates it, its value and its first and
second derivatives are those of R. A residual needs R and ∂R, a Jacobian ∂²R too.

Derivation. Let A = R₀ᵀF, symmetric at F₀. R(F) = R₀ Q(b), Q(b) = (1 + b·b)⁻¹ ((1 - b·b) I +
2 [b]ₓ + 2 b bᵀ) the rotation of the quaternion (1, b), maximises tr(RᵀF). The maximum f is the
largest eigenvalue of Horn's 4×4 matrix of A with eigenvector (1, b), which reads

    M(f) b = a,   f = tr A + a·b,   M(f) = (f + tr A) I - 2 sym A,   a = axial(A - Aᵀ).

a vanishes at F₀, so f = tr A + O(a²) and b = M(tr A)⁻¹ a + O(a³). Write D = sym A - S₀ and
G = M(tr S₀)⁻¹ = (2 (tr S₀ I - S₀))⁻¹; expanding the inverse, to second order,

    b = b₁ + b₂,   b₁ = G a,   b₂ = -2 G (tr D I - D) b₁,
    R = R₀ (I + 2 [b₁ + b₂]ₓ + 2 [b₁]ₓ²),

a polynomial of degree two in F with coefficients R₀, S₀, G. G exists wherever σᵢ + σⱼ ≠ 0, that is
wherever R is smooth: at rest, with equal singular values, and for det F < 0 while σ₂ + σ₃ ≠ 0.

Where two singular values cancel, R is one of the rotations that maximise tr(RᵀF), which are many,
and has no derivative. There the sum of the two counts as no less than `GAP` times the largest, or
than `GAP` if that is below 1, which leaves derivatives finite: of the order 1/GAP, and 1/GAP². In
2D R is the identity there, and constant.

B. K. P. Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 4 (1987).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import ufl
from ufl.core.expr import Expr

from forms.cell_data import CellData, frozen, intermediate, linearisation, marked

_LOWER = np.tril_indices(3)

GAP = 1e-8
"""Least sum of two singular values that R is differentiated with; that of `code/polar.h`."""


class _PolarData(CellData):
    """R₀ (9), S₀ (6) and G (6) of each point, in one coefficient of 21 components."""

    code = Path(__file__).parent / "code" / "polar.h"
    rank, kept = 3, 6

    def __init__(self, F: Expr) -> None:
        super().__init__(F, (21,), "polar")
        self.rotation = marked(self._expansion(), self)

    def compute(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        R, S, G = polar_factors(values)
        return np.concatenate([R.reshape(-1, 9), S[:, *_LOWER], G[:, *_LOWER]], axis=1)

    def _expansion(self) -> Expr:
        lower = [[0, 1, 3], [1, 2, 4], [3, 4, 5]]
        full = [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
        R0, S0, G = (
            ufl.as_matrix([[self[offset + k] for k in row] for row in table])
            for offset, table in ((0, full), (9, lower), (15, lower))
        )
        A = R0.T * self.argument
        D = ufl.sym(A) - S0
        I = ufl.Identity(3)  # noqa: E741
        b1 = G * _axial(A)
        b2 = -2 * G * ((ufl.tr(D) * I - D) * b1)
        return R0 * (I + 2 * _cross(b1) + 2 * _cross(b2) + 2 * _cross(b1) * _cross(b1))


def polar_factors(
    F: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return R, S and G = (2 (tr S I - S))⁻¹ of deformation gradients.

    Where det F < 0 the smallest singular value is taken negative, so that R stays in SO(3).

    Args:
        F: Deformation gradients, shape (n, 3, 3).

    Returns:
        Three arrays of shape (n, 3, 3). No sum in G is below `GAP`.

    Raises:
        numpy.linalg.LinAlgError: An F that is not finite.
    """
    U, sigma, Vt = np.linalg.svd(F)
    reflected = np.linalg.det(U @ Vt) < 0.0
    U[reflected, :, 2] *= -1.0
    sigma[reflected, 2] *= -1.0
    V = Vt.transpose(0, 2, 1)
    S = np.einsum("nik,nk,njk->nij", V, sigma, V)
    sums = sigma.sum(axis=1, keepdims=True) - sigma
    gamma = 0.5 / np.maximum(sums, GAP * np.maximum(1.0, sigma[:, :1]))
    G = np.einsum("nik,nk,njk->nij", V, gamma, V)
    return U @ Vt, S, G


def _cross(b: Expr) -> Expr:
    """The skew matrix [b]ₓ with [b]ₓ v = b × v."""
    return ufl.as_matrix([[0, -b[2], b[1]], [b[2], 0, -b[0]], [-b[1], b[0], 0]])


def _axial(A: Expr) -> Expr:
    """The axial vector of A - Aᵀ."""
    return ufl.as_vector([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])


def polar_rotation(F: Expr) -> Expr:
    """Return R(F) in SO(d), with exact first and second UFL derivatives, shape (d, d).

    In 3D the expression holds per-cell data (`CellData`) that a solver refreshes; in 2D it is the
    closed form R = (F + cof F) / |F + cof F| √2, exact to every order.

    Args:
        F: Deformation gradient, any expression of finite element functions, shape (d, d).
    """
    if F.ufl_shape == (2, 2):
        c, s = F[0, 0] + F[1, 1], F[1, 0] - F[0, 1]
        mirrored = ufl.lt(c**2 + s**2, GAP**2)
        c, s = ufl.conditional(mirrored, 1.0, c), ufl.conditional(mirrored, 0.0, s)
        r = ufl.sqrt(c**2 + s**2)
        return ufl.as_matrix([[c / r, -s / r], [s / r, c / r]])
    return _PolarData.of(F).rotation


def right_stretch(F: Expr) -> Expr:
    """Return S(F) = sym(RᵀF), with exact first and second UFL derivatives, shape (d, d).

    Args:
        F: Deformation gradient, shape (d, d).
    """
    return intermediate(ufl.sym(polar_rotation(F).T * F))


def linearised_stretch(F: Expr) -> Expr:
    """Return S(F) with its exact first UFL derivative and a second one of zero, shape (d, d).

    With R, S frozen at the present F, A = RᵀF and [ω]ₓ = Rᵀ δR, (tr S I - S) ω = axial(A - Aᵀ),
    it is sym(A - [ω]ₓ S), affine in F.

    Args:
        F: Deformation gradient, shape (d, d).
    """
    R, S = frozen(polar_rotation(F)), right_stretch(F)
    A = R.T * F
    if F.ufl_shape == (2, 2):
        omega = (A[1, 0] - A[0, 1]) / frozen(ufl.tr(S))
        turn = ufl.as_matrix([[0, -omega], [omega, 0]])
    else:
        turn = _cross(frozen(ufl.inv(ufl.tr(S) * ufl.Identity(3) - S)) * _axial(A))
    return linearisation(ufl.sym(A - turn * frozen(S)), S)


def quaternion_rotation(q: Expr) -> Expr:
    """Return the rotation in SO(d) of a quaternion, in 2D of a complex number, of any length.

    Args:
        q: Shape (4,), scalar part first, or (2,), real part first; not zero.
    """
    if len(q) == 2:
        return ufl.as_matrix([[q[0], -q[1]], [q[1], q[0]]]) / ufl.sqrt(ufl.inner(q, q))
    v = ufl.as_vector([q[1], q[2], q[3]])
    turned = (q[0] ** 2 - ufl.inner(v, v)) * ufl.Identity(3) + 2 * q[0] * _cross(v)
    return (turned + 2 * ufl.outer(v, v)) / ufl.inner(q, q)
