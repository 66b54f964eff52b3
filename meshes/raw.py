"""A mesh as its file has it, and the checks it must pass."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl

from meshes.body import MeshError

SIMPLEX = {"triangle": 2, "tetra": 3}  # cells a body may have, with their dimension
TAGGED = {"vertex": 0, "line": 1, **SIMPLEX}  # entities that may carry a tag
# Cells flatter than this, relative to the d-th power of their longest edge, have no volume.
_FLAT = 1e-12

Integers = npt.NDArray[np.int64]


@dataclass
class RawMesh:
    """A mesh file in memory, in its own order."""

    points: npt.NDArray[np.float64]  # (vertices, d)
    cells: Integers  # (cells, d + 1)
    tags: npt.NDArray[np.int32]  # (cells,)
    groups: dict[str | int, Integers] = field(default_factory=dict)


def domain(d: int) -> ufl.Mesh:
    """Straight simplices in d dimensions, as DOLFINx declares them for its own boxes."""
    cell = "triangle" if d == 2 else "tetrahedron"
    element = basix.ufl.element("Lagrange", cell, 1, shape=(d,))
    return ufl.Mesh(element)


def cell_kind(kinds: set[str]) -> str:
    """The one kind of cell among the entities of a file."""
    foreign = sorted(kinds - set(TAGGED))
    if foreign:
        mixed = "a mix of cells" if kinds & set(SIMPLEX) else "cells"
        raise MeshError(
            f"has {mixed} of type {', '.join(foreign)}; straight triangles (2D) or tetrahedra "
            "(3D) are wanted"
        )
    if not kinds & set(SIMPLEX):
        raise MeshError("has no cells; straight triangles (2D) or tetrahedra (3D) are wanted")
    return "tetra" if "tetra" in kinds else "triangle"


def planar(points: npt.NDArray[np.float64], d: int) -> npt.NDArray[np.float64]:
    """Drop the third coordinate of a flat mesh of triangles."""
    if points.shape[1] == d:
        return points
    if points.shape[1] < d:
        raise MeshError(f"has {points.shape[1]} coordinates a vertex, {d} are wanted")
    if np.ptp(points[:, d:], axis=0).max() > 0:
        raise MeshError(
            "is a surface of triangles in space; fill it with tetrahedra, or give a flat mesh "
            "at constant z"
        )
    return np.ascontiguousarray(points[:, :d])


def check(raw: RawMesh) -> None:
    """Refuse a mesh on which the energies of the method are not defined.

    Raises:
        MeshError: Coordinates that are not finite, vertices without a cell, cells that are flat,
            fold over a neighbour or share a facet three at a time.
    """
    points, cells = raw.points, raw.cells
    d = points.shape[1]
    if not np.isfinite(points).all():
        first = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise MeshError(f"vertex {first} (from 0) has coordinates that are not finite")
    if cells.min() < 0 or cells.max() >= len(points):
        raise MeshError(f"a cell names a vertex that the file's {len(points)} do not include")
    lonely = np.setdiff1d(np.arange(len(points)), cells)
    if len(lonely):
        are, them = ("vertices belong", "them") if len(lonely) > 1 else ("vertex belongs", "it")
        raise MeshError(f"{len(lonely)} {are} to no cell (the first is {lonely[0]}); remove {them}")

    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    longest = np.max(
        [np.linalg.norm(corners[:, i] - corners[:, j], axis=1)
         for i, j in combinations(range(d + 1), 2)], axis=0
    )  # fmt: skip
    flat = np.flatnonzero(np.abs(np.linalg.det(edges)) <= _FLAT * longest**d)
    if len(flat):
        noun = "cells have" if len(flat) > 1 else "cell has"
        raise MeshError(f"{len(flat)} {noun} no volume (the first is cell {flat[0]}, from 0)")
    _check_facets(points, cells)


def _check_facets(points: npt.NDArray[np.float64], cells: Integers) -> None:
    """Cells that share a facet must lie on opposite sides of it, and be two at most."""
    d = points.shape[1]
    facets = np.concatenate([np.delete(cells, i, axis=1) for i in range(d + 1)])
    apex = cells.T.ravel()  # the vertex opposite each facet
    owner = np.tile(np.arange(len(cells)), d + 1)
    facets = np.sort(facets, axis=1)
    order = np.lexsort(facets.T[::-1])
    facets, apex, owner = facets[order], apex[order], owner[order]
    same = (facets[1:] == facets[:-1]).all(axis=1)
    triple = np.flatnonzero(same[1:] & same[:-1])
    if len(triple):
        a, b, c = sorted(int(owner[triple[0] + i]) for i in range(3))
        raise MeshError(f"cells {a}, {b} and {c} (from 0) share one facet; two may at most")
    pair = np.flatnonzero(same)
    base = points[facets[pair]]
    sides = [
        np.linalg.det(
            np.concatenate([base[:, 1:], points[apex[pair + i]][:, None]], axis=1) - base[:, :1]
        )
        for i in (0, 1)
    ]
    folded = np.flatnonzero(sides[0] * sides[1] > 0)
    if len(folded):
        a, b = sorted(int(owner[pair[folded[0]] + i]) for i in (0, 1))
        noun = "pairs of cells overlap" if len(folded) > 1 else "pair of cells overlaps"
        raise MeshError(
            f"{len(folded)} {noun}: cells {a} and {b} (from 0) lie on the same side of the facet "
            "they share (one is inverted)"
        )
