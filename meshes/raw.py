"""A mesh as its file has it, and the checks it must pass."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

from mpi4py import MPI

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.mesh import (
    CellType,
    GhostMode,
    Mesh,
    cell_dim,
    create_cell_partitioner,
    create_mesh,
)

from meshes.body import MeshError

# Kinds of cells that a body may have, by meshio's names.
KINDS = {
    "triangle": CellType.triangle,
    "quad": CellType.quadrilateral,
    "tetra": CellType.tetrahedron,
    "hexahedron": CellType.hexahedron,
}
# Entities that may carry a tag, with their dimension.
TAGGED = {"vertex": 0, "line": 1} | {name: cell_dim(kind) for name, kind in KINDS.items()}
_WANTED = "straight triangles or quadrilaterals (2D), tetrahedra or hexahedra (3D) are wanted"
# Cells flatter than this, relative to the d-th power of their longest edge, have no volume.
_FLAT = 1e-12

Integers = npt.NDArray[np.int64]


@dataclass
class RawMesh:
    """A mesh file in memory, in its own order."""

    kind: CellType
    points: npt.NDArray[np.float64]  # (vertices, d)
    cells: Integers  # (cells, vertices of a cell), a cell's vertices in DOLFINx's order
    tags: npt.NDArray[np.int32]  # (cells,)
    groups: dict[str | int, Integers] = field(default_factory=dict)

    @property
    def simplicial(self) -> bool:
        """Whether the cells are triangles or tetrahedra."""
        return self.cells.shape[1] == self.points.shape[1] + 1


def domain(kind: CellType) -> ufl.Mesh:
    """Straight cells, as DOLFINx declares them for its own boxes."""
    element = basix.ufl.element("Lagrange", kind.name, 1, shape=(cell_dim(kind),))
    return ufl.Mesh(element)


def distribute(
    comm: MPI.Comm, kind: CellType, cells: Integers, points: npt.NDArray[np.float64]
) -> Mesh[np.float64]:
    """A mesh with one ghost layer of what each rank gives of it. Collective."""
    # singledispatch hides this overload from type checkers
    partitioner = create_cell_partitioner(GhostMode.shared_facet, 2)  # type: ignore[call-arg]
    return create_mesh(comm, cells, domain(kind), points, partitioner)


def cell_kind(kinds: set[str]) -> str:
    """The one kind of cell among the entities of a file."""
    d = max((TAGGED[kind] for kind in kinds & set(KINDS)), default=0)
    cells = {kind for kind in kinds & set(KINDS) if TAGGED[kind] == d}
    foreign = sorted(kinds - set(TAGGED))
    if foreign or len(cells) > 1:
        mixed = "a mix of cells" if cells else "cells"
        raise MeshError(f"has {mixed} of type {', '.join(foreign or sorted(cells))}; {_WANTED}")
    if not cells:
        raise MeshError(f"has no cells; {_WANTED}")
    return cells.pop()


def planar(points: npt.NDArray[np.float64], d: int) -> npt.NDArray[np.float64]:
    """Drop the third coordinate of a flat mesh."""
    if points.shape[1] == d:
        return points
    if points.shape[1] < d:
        raise MeshError(f"has {points.shape[1]} coordinates a vertex, {d} are wanted")
    if np.ptp(points[:, d:], axis=0).max() > 0:
        raise MeshError(
            "is a surface in space; fill it with tetrahedra or hexahedra, or give a flat mesh at "
            "constant z"
        )
    return np.ascontiguousarray(points[:, :d])


def check(raw: RawMesh) -> None:
    """Refuse a mesh on which the energies of the method are not defined.

    Raises:
        MeshError: Coordinates that are not finite, vertices without a cell, cells that are flat,
            turn over within themselves, fold over a neighbour or share a facet three at a time.
    """
    points, cells = raw.points, raw.cells
    if not np.isfinite(points).all():
        first = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise MeshError(f"vertex {first} (from 0) has coordinates that are not finite")
    if cells.min() < 0 or cells.max() >= len(points):
        raise MeshError(f"a cell names a vertex that the file's {len(points)} do not include")
    lonely = np.setdiff1d(np.arange(len(points)), cells)
    if len(lonely):
        are, them = ("vertices belong", "them") if len(lonely) > 1 else ("vertex belongs", "it")
        raise MeshError(f"{len(lonely)} {are} to no cell (the first is {lonely[0]}); remove {them}")

    jacobians = _jacobians(raw)
    flat = np.flatnonzero((np.abs(jacobians) <= _FLAT).any(axis=1))
    if len(flat):
        noun = "cells have" if len(flat) > 1 else "cell has"
        where = "" if raw.simplicial else " at a vertex"
        raise MeshError(
            f"{len(flat)} {noun} no volume{where} (the first is cell {flat[0]}, from 0)"
        )
    signs = np.sign(jacobians)
    turned = np.flatnonzero((signs != signs[:, :1]).any(axis=1))
    if len(turned):
        are = "cells are" if len(turned) > 1 else "cell is"
        list_their = "list their" if len(turned) > 1 else "lists its"
        raise MeshError(
            f"{len(turned)} {are} not convex, or {list_their} vertices in another order than the "
            f"format's (the first is cell {turned[0]}, from 0)"
        )
    _check_facets(raw)


def _jacobians(raw: RawMesh) -> npt.NDArray[np.float64]:
    """Determinants of the edges at a cell's vertices, by the d-th power of its longest edge.

    Shape (cells, 1) for simplices, on which it is constant, else (cells, vertices of a cell).
    """
    corners = raw.points[raw.cells]
    d = raw.points.shape[1]
    if raw.simplicial:
        pairs = list(combinations(range(d + 1), 2))
        edges = (corners[:, 1:] - corners[:, :1])[:, None]
    else:
        # Vertices count in binary, an axis of the reference cell a digit.
        vertices, axes = np.arange(2**d)[:, None], 2 ** np.arange(d)
        forward = np.where(vertices & axes, -1.0, 1.0)
        pairs = [(v, v | 1 << i) for v in range(2**d) for i in range(d) if not v >> i & 1]
        edges = forward[:, :, None] * (corners[:, vertices ^ axes] - corners[:, :, None])
    lengths = [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in pairs]
    longest = np.maximum(np.max(lengths, axis=0), np.finfo(float).tiny)
    jacobians: npt.NDArray[np.float64] = np.linalg.det(edges / longest[:, None, None, None])
    return jacobians


def _check_facets(raw: RawMesh) -> None:
    """Cells that share a facet must lie on opposite sides of it, and be two at most."""
    points, cells = raw.points, raw.cells
    d = points.shape[1]
    topology = basix.topology(getattr(basix.CellType, raw.kind.name))[d - 1]
    facets = np.concatenate([cells[:, facet] for facet in topology])
    every = np.arange(cells.shape[1])
    # The middle of a cell's vertices that are not on the facet.
    opposite = np.concatenate(
        [points[cells[:, np.setdiff1d(every, facet)]].mean(axis=1) for facet in topology]
    )
    owner = np.tile(np.arange(len(cells)), len(topology))
    facets = np.sort(facets, axis=1)
    order = np.lexsort(facets.T[::-1])
    facets, opposite, owner = facets[order], opposite[order], owner[order]
    same = (facets[1:] == facets[:-1]).all(axis=1)
    triple = np.flatnonzero(same[1:] & same[:-1])
    if len(triple):
        a, b, c = sorted(int(owner[triple[0] + i]) for i in range(3))
        raise MeshError(f"cells {a}, {b} and {c} (from 0) share one facet; two may at most")
    pair = np.flatnonzero(same)
    base = points[facets[pair, :d]]
    sides = [
        np.linalg.det(
            np.concatenate([base[:, 1:], opposite[pair + i][:, None]], axis=1) - base[:, :1]
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
