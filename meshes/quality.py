"""Sizes and shapes of cells."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

from meshes.raw import RawMesh

Reals = npt.NDArray[np.float64]


def edge_lengths(raw: RawMesh) -> Reals:
    """Lengths of the edges of each cell, shape (cells, edges of a cell)."""
    corners = raw.points[raw.cells]
    d = raw.points.shape[1]
    if raw.simplicial:
        pairs = list(combinations(range(d + 1), 2))
    else:
        # Vertices count in binary, an axis of the reference cell a digit.
        pairs = [(v, v | 1 << i) for v in range(2**d) for i in range(d) if not v >> i & 1]
    lengths = [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in pairs]
    return np.stack(lengths, axis=1)


def corner_edges(raw: RawMesh) -> Reals:
    """The d edges at a vertex, of simplices at the first, else at each and turned to one sense.

    Shape (cells, vertices or 1, edges d, components d). The determinant of the edges is d! times
    the volume of a simplex, and the Jacobian at a vertex of another cell.
    """
    corners = raw.points[raw.cells]
    d = raw.points.shape[1]
    if raw.simplicial:
        return np.asarray((corners[:, 1:] - corners[:, :1])[:, None])
    vertices, axes = np.arange(2**d)[:, None], 2 ** np.arange(d)
    forward = np.where(vertices & axes, -1.0, 1.0)
    edges = corners[:, vertices ^ axes] - corners[:, :, None]
    return np.asarray(forward[:, :, None] * edges)


def sizes(raw: RawMesh) -> Reals:
    """The longest edge of each cell [m], its diameter if it is a simplex."""
    return np.asarray(edge_lengths(raw).max(axis=1))


def measure_name(raw: RawMesh) -> str:
    """What `quality` measures."""
    if raw.simplicial:
        return f"radius ratio ({raw.points.shape[1]} r / R, inscribed by circumscribed)"
    return "scaled Jacobian (the least over the vertices)"


def quality(raw: RawMesh) -> Reals:
    """Shape of each cell: 1 for an equilateral or a rectangular one, 0 for a flat one.

    Of simplices d r / R, with the radii of the inscribed and the circumscribed sphere; of others
    the least Jacobian at a vertex by the product of the edges there, negative where the cell turns
    over.
    """
    edges = corner_edges(raw)
    with np.errstate(divide="ignore", invalid="ignore"):
        if not raw.simplicial:
            scaled = np.linalg.det(edges) / np.linalg.norm(edges, axis=3).prod(axis=2)
            sense = np.sign(scaled.sum(axis=1, keepdims=True))
            values = (sense * scaled).min(axis=1)
        elif edges.shape[-1] == 2:
            a, b, c = edge_lengths(raw).T
            values = (b + c - a) * (c + a - b) * (a + b - c) / (a * b * c)
        else:
            values = _tetrahedra(edges[:, 0], edge_lengths(raw))
    return np.nan_to_num(np.asarray(values), nan=0.0, posinf=0.0, neginf=0.0)


def _tetrahedra(edges: Reals, lengths: Reals) -> Reals:
    """3 r / R by the volume V, the areas A, and products p of the lengths of opposite edges.

    r = 3 V / Σ A,  R = √((p₀ + p₁ + p₂)(p₁ + p₂ − p₀)(p₂ + p₀ − p₁)(p₀ + p₁ − p₂)) / (24 V).
    """
    volume = np.abs(np.linalg.det(edges)) / 6.0
    a, b, c = edges[:, 0], edges[:, 1], edges[:, 2]
    faces = ((a, b), (b, c), (c, a), (b - a, c - a))
    areas = sum(np.linalg.norm(np.cross(p, q), axis=1) / 2.0 for p, q in faces)
    # Edges come as 01, 02, 03, 12, 13, 23.
    p, q, r = (
        lengths[:, 0] * lengths[:, 5],
        lengths[:, 1] * lengths[:, 4],
        lengths[:, 2] * lengths[:, 3],
    )
    root = np.sqrt(np.maximum((p + q + r) * (q + r - p) * (r + p - q) * (p + q - r), 0.0))
    return np.asarray(216.0 * volume**2 / (areas * root))


def volumes(raw: RawMesh) -> Reals:
    """Volume of each cell [m³], in 2D its area [m²]; exact for hexahedra with plane faces."""
    d = raw.points.shape[1]
    corners = raw.points[raw.cells]
    if raw.simplicial:
        return np.asarray(np.abs(np.linalg.det(corner_edges(raw)[:, 0])) / (2.0 if d == 2 else 6.0))
    total = np.zeros(len(corners))
    for point in np.stack(np.meshgrid(*[(-1.0, 1.0)] * d), axis=-1).reshape(-1, d) / np.sqrt(3.0):
        bits = np.arange(2**d)[:, None] >> np.arange(d) & 1
        factors = (1.0 + np.where(bits, 1.0, -1.0) * point) / 2.0
        slopes = np.stack(
            [
                np.where(bits[:, i], 0.5, -0.5) * np.delete(factors, i, axis=1).prod(axis=1)
                for i in range(d)
            ],
            axis=1,
        )
        total += np.abs(np.linalg.det(np.einsum("kvi,vj->kij", corners, slopes)))
    return total
