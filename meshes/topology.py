"""The facets of a mesh in memory."""

from __future__ import annotations

import basix
import numpy as np
import numpy.typing as npt

from meshes.groups import Integers
from meshes.raw import RawMesh


def local_facets(raw: RawMesh) -> list[list[int]]:
    """The vertices of each facet of a cell, counted within the cell."""
    d = raw.points.shape[1]
    return list(basix.topology(getattr(basix.CellType, raw.kind.name))[d - 1])


def all_facets(raw: RawMesh) -> tuple[Integers, Integers]:
    """Facets of all cells, with their vertices in DOLFINx's order, and the cell of each."""
    local = local_facets(raw)
    facets = np.concatenate([raw.cells[:, facet] for facet in local])
    return facets, np.tile(np.arange(len(raw.cells)), len(local))


def boundary_facets(raw: RawMesh) -> Integers:
    """The facets that only one cell has."""
    facets, _ = all_facets(raw)
    order, same = _sorted(facets)
    alone = ~(np.r_[False, same] | np.r_[same, False])
    return facets[np.sort(order[alone])]


def neighbours(raw: RawMesh) -> Integers:
    """Pairs of cells that share a facet, shape (pairs, 2)."""
    facets, cells = all_facets(raw)
    order, same = _sorted(facets)
    return np.stack([cells[order[:-1][same]], cells[order[1:][same]]], axis=1)


def _sorted(facets: Integers) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """An order in which equal facets follow one another, and whether the next one is equal."""
    rows = np.sort(facets, axis=1)
    order = np.lexsort(rows.T[::-1])
    return order, (rows[order][1:] == rows[order][:-1]).all(axis=1)
