"""Orderings of the discrete unknowns: vec, symmetric dofs and skew generators.

- vec(A) of a d×d matrix is row-major: entry d i + j is A_ij.
- A symmetric matrix has the dofs 00, 10, 11 (2D) or 00, 10, 11, 20, 21, 22 (3D); an off-diagonal
  dof stands for both entries, S = Σ_k s_k B_k. A derivative with respect to such a dof therefore
  counts both entries.
- A : B is Σ_ij A_ij B_ij, sym(A) is (A + Aᵀ)/2 and skew(A) is (A - Aᵀ)/2.
- A skew matrix is W = Σ_a ω_a E_a with one generator in 2D and three in 3D, where W y = ω × y.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def einsum(subscripts: str, *operands: Array) -> Array:
    """`numpy.einsum`, pairwise contraction for three operands or more, with a return type."""
    result: Array = np.einsum(subscripts, *operands, optimize=len(operands) > 2)
    return result


@cache
def symmetric_basis(d: int) -> Array:
    """Return the matrices B_k, shape (d (d + 1) / 2, d, d)."""
    rows, columns = np.tril_indices(d)
    basis = np.zeros((len(rows), d, d))
    k = np.arange(len(rows))
    basis[k, rows, columns] = 1.0
    basis[k, columns, rows] = 1.0
    basis.flags.writeable = False
    return basis


@cache
def skew_basis(d: int) -> Array:
    """Return the generators E_a of rotations, shape (1, 2, 2) or (3, 3, 3)."""
    if d == 2:
        basis = np.array([[[0.0, -1.0], [1.0, 0.0]]])
    else:
        basis = np.zeros((3, 3, 3))
        for a, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            basis[a, j, i], basis[a, i, j] = 1.0, -1.0
    basis.flags.writeable = False
    return basis


def symmetric_dofs(S: Array) -> Array:
    """Return the dofs (..., d (d + 1) / 2) of symmetric matrices (..., d, d)."""
    rows, columns = np.tril_indices(S.shape[-1])
    dofs: Array = S[..., rows, columns]
    return dofs


def symmetric_tensor(s: Array) -> Array:
    """Return the symmetric matrices (..., d, d) of dofs (..., d (d + 1) / 2), d = 2 or 3."""
    return einsum("...k,kij->...ij", s, symmetric_basis({3: 2, 6: 3}[s.shape[-1]]))


def dof_weights(d: int) -> Array:
    """Return B_k : B_k, which is 1 on the diagonal and 2 off it: Y : S = Σ_k w_k y_k s_k."""
    return einsum("kij,kij->k", symmetric_basis(d), symmetric_basis(d))
