"""Linear triangles and tetrahedra: volume V_K, Jacobian J_K (eq. 4) and mass.

Degrees of freedom of positions are numbered d * vertex + component.
"""

from __future__ import annotations

from math import factorial

import numpy as np
import scipy.sparse as sp

from demos.by_hand.basis import Array, IntArray, einsum


def volumes(X: Array, cells: IntArray) -> Array:
    """Return V_K [m³, m² in 2D], positive whatever the order of a cell's vertices; shape (n_e,).

    Raises:
        ValueError: A cell has no volume.
    """
    edges = X[cells[:, 1:]] - X[cells[:, :1]]
    volume: Array = np.abs(np.linalg.det(edges)) / factorial(X.shape[1])
    size = np.max(np.linalg.norm(edges, axis=2), axis=1)
    flat = volume <= 1e-14 * size ** X.shape[1]
    if np.any(flat):
        raise ValueError(f"cells {np.flatnonzero(flat)[:10].tolist()} are flat: volume 0")
    return volume


def element_jacobians(X: Array, cells: IntArray) -> Array:
    """Return J_K on the cell's own dofs, (n_e, d², d (d + 1)): J_K x_K = vec(F_K) (eq. 4).

    F_ij = Σ_a x_ai ∂N_a/∂X_j with the hat functions N_a of the cell.
    """
    n, d = len(cells), X.shape[1]
    edges = X[cells[:, 1:]] - X[cells[:, :1]]  # row a is an edge; N_a is linear with N_a(edge_b)=δ
    gradients = np.empty((n, d + 1, d))
    gradients[:, 1:] = np.swapaxes(np.linalg.inv(edges), 1, 2)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    return einsum("naj,ic->nijac", gradients, np.eye(d)).reshape(n, d * d, d * (d + 1))


def cell_dofs(cells: IntArray, d: int) -> IntArray:
    """Return the position dofs of each cell, shape (n_e, d (d + 1))."""
    return (d * cells[:, :, None] + np.arange(d)).reshape(len(cells), -1)


def global_jacobian(J_K: Array, cells: IntArray, vertices: int, d: int) -> sp.csr_array:
    """Return the sparse J, (d² n_e, d n), whose rows d² K … are J_K."""
    n = len(cells)
    rows = np.broadcast_to(np.arange(n * d * d).reshape(n, d * d, 1), J_K.shape)
    columns = np.broadcast_to(cell_dofs(cells, d)[:, None, :], J_K.shape)
    return sp.csr_array(
        (J_K.ravel(), (rows.ravel(), columns.ravel())), shape=(n * d * d, vertices * d)
    )


def mass_matrix(
    volume: Array, rho: float | Array, cells: IntArray, vertices: int, d: int
) -> sp.csr_array:
    """Return the consistent mass matrix M [kg], sparse, (d n, d n).

    ∫ ρ N_a N_b over a cell is ρ V_K (1 + δ_ab) / ((d + 1) (d + 2)).
    """
    n = len(cells)
    local = (1.0 + np.eye(d + 1)) / ((d + 1) * (d + 2))
    weight = np.broadcast_to(np.asarray(rho, dtype=float), (n,)) * volume
    values = einsum("n,ab,ij->naibj", weight, local, np.eye(d)).reshape(n, d * (d + 1), -1)
    dofs = cell_dofs(cells, d)
    rows = np.broadcast_to(dofs[:, :, None], values.shape)
    columns = np.broadcast_to(dofs[:, None, :], values.shape)
    return sp.csr_array(
        (values.ravel(), (rows.ravel(), columns.ravel())), shape=(vertices * d, vertices * d)
    )


def block_diagonal(blocks: Array) -> sp.csr_array:
    """Return the sparse matrix with the (p, q) blocks of shape (n_e, p, q) on its diagonal."""
    n, p, q = blocks.shape
    return sp.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(n * p, n * q)).tocsr()
