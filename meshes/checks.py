"""What makes a mesh unusable: the energies of the method are not defined on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.groups import Integers, repeated_rows
from meshes.quality import corner_edges, edge_lengths
from meshes.raw import RawMesh, strange
from meshes.topology import local_facets

# Problems with which a mesh has neither sizes nor neighbours.
BEYOND = ("coordinates that are not finite", "unknown vertices")
# Cells flatter than this, relative to the d-th power of their longest edge, have no volume.
_FLAT = 1e-12


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a mesh.

    Attributes:
        name: What it is called.
        message: One line that says what and where.
        noun: What is counted, "cells" or "vertices".
        numbers: All of them by their file numbers, in ascending order.
        fatal: Whether the mesh cannot be used.
    """

    name: str
    message: str
    noun: str
    numbers: Integers
    fatal: bool = True


def check(raw: RawMesh) -> None:
    """Refuse a mesh on which the energies of the method are not defined.

    Raises:
        MeshError: Coordinates that are not finite, vertices without a cell, cells that are flat,
            turn over within themselves, come twice, fold over a neighbour or share a facet three
            at a time.
    """
    for problem in fatal_problems(raw):
        raise MeshError(problem.message)


def fatal_problems(raw: RawMesh) -> Iterator[Problem]:
    """Everything for which a mesh is refused; no more than one where the rest makes no sense."""
    points, cells = raw.points, raw.cells
    infinite = strange(points)
    if len(infinite):
        said = f"vertex {infinite[0]} (from 0) has coordinates that are not finite"
        yield Problem(BEYOND[0], said, "vertices", infinite)
        return
    if cells.min() < 0 or cells.max() >= len(points):
        wrong = np.flatnonzero(((cells < 0) | (cells >= len(points))).any(axis=1))
        said = f"a cell names a vertex that the file's {len(points)} do not include"
        yield Problem(BEYOND[1], said, "cells", wrong)
        return
    lonely = np.setdiff1d(np.arange(len(points)), cells)
    if len(lonely):
        are, them = ("vertices belong", "them") if len(lonely) > 1 else ("vertex belongs", "it")
        said = f"{len(lonely)} {are} to no cell (the first is {lonely[0]}); remove {them}"
        yield Problem("unused vertices", said, "vertices", lonely)
    yield from _shapes(raw)
    repeated, first = _repeated(cells)
    if len(repeated):
        are = "cells are" if len(repeated) > 1 else "cell is"
        said = (
            f"{len(repeated)} {are} listed twice: cell {repeated[0]} (from 0) has the vertices of "
            f"cell {first[0]}"
        )
        yield Problem("duplicate cells", said, "cells", repeated)
    yield from _facets(raw, np.delete(np.arange(len(cells)), repeated))


def _shapes(raw: RawMesh) -> Iterator[Problem]:
    jacobians = _jacobians(raw)
    flat = np.flatnonzero((np.abs(jacobians) <= _FLAT).any(axis=1))
    if len(flat):
        noun = "cells have" if len(flat) > 1 else "cell has"
        where = "" if raw.simplicial else " at a vertex"
        said = f"{len(flat)} {noun} no volume{where} (the first is cell {flat[0]}, from 0)"
        yield Problem("degenerate cells", said, "cells", flat)
    signs = np.sign(jacobians)
    turned = np.setdiff1d(np.flatnonzero((signs != signs[:, :1]).any(axis=1)), flat)
    if len(turned):
        are = "cells are" if len(turned) > 1 else "cell is"
        list_their = "list their" if len(turned) > 1 else "lists its"
        said = (
            f"{len(turned)} {are} not convex, or {list_their} vertices in another order than the "
            f"format's (the first is cell {turned[0]}, from 0)"
        )
        yield Problem("twisted cells", said, "cells", turned)


def _jacobians(raw: RawMesh) -> npt.NDArray[np.float64]:
    """Determinants of the edges at a cell's vertices, by the d-th power of its longest edge.

    Shape (cells, 1) for simplices, on which it is constant, else (cells, vertices of a cell).
    """
    longest = np.maximum(edge_lengths(raw).max(axis=1), np.finfo(float).tiny)
    jacobians: npt.NDArray[np.float64] = np.linalg.det(
        corner_edges(raw) / longest[:, None, None, None]
    )
    return jacobians


def _repeated(cells: Integers) -> tuple[Integers, Integers]:
    """Cells that have the vertices of a former one, and the first of those."""
    rows = np.sort(cells, axis=1)
    if not repeated_rows(rows):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    order = np.lexsort(rows.T[::-1])
    same = (rows[order][1:] == rows[order][:-1]).all(axis=1)
    # lexsort is stable, so the first of equal rows is the first in the file.
    leader = np.maximum.accumulate(np.where(np.r_[True, ~same], np.arange(len(cells)), 0))
    again = np.flatnonzero(np.r_[False, same])
    numbers = np.argsort(order[again])
    return order[again][numbers], order[leader[again]][numbers]


def _facets(raw: RawMesh, chosen: Integers) -> Iterator[Problem]:
    """Cells that share a facet must lie on opposite sides of it, and be two at most."""
    points, cells = raw.points, raw.cells[chosen]
    d = points.shape[1]
    topology = local_facets(raw)
    facets = np.concatenate([cells[:, facet] for facet in topology])
    every = np.arange(cells.shape[1])
    # The middle of a cell's vertices that are not on the facet.
    opposite = np.concatenate(
        [points[cells[:, np.setdiff1d(every, facet)]].mean(axis=1) for facet in topology]
    )
    owner = np.tile(chosen, len(topology))
    facets = np.sort(facets, axis=1)
    order = np.lexsort(facets.T[::-1])
    facets, opposite, owner = facets[order], opposite[order], owner[order]
    same = (facets[1:] == facets[:-1]).all(axis=1)
    triple = np.flatnonzero(same[1:] & same[:-1])
    if len(triple):
        a, b, c = sorted(int(owner[triple[0] + i]) for i in range(3))
        said = f"cells {a}, {b} and {c} (from 0) share one facet; two may at most"
        numbers = np.unique(owner[triple[:, None] + np.arange(3)])
        yield Problem("facets of three cells", said, "cells", numbers)
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
        said = (
            f"{len(folded)} {noun}: cells {a} and {b} (from 0) lie on the same side of the facet "
            "they share (one is inverted)"
        )
        numbers = np.unique(owner[pair[folded][:, None] + np.arange(2)])
        yield Problem("overlapping cells", said, "cells", numbers)
