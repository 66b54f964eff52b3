"""Generated bodies."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

from meshes.body import Body
from meshes.errors import MeshError

CELLS = {2: ("triangle", "quadrilateral"), 3: ("tetrahedron", "hexahedron")}
"""Kinds of cells of a box by dimension, the default first."""


def box(
    comm: MPI.Comm, size: Sequence[float], cells: Sequence[int], cell: str | None = None
) -> Body:
    """A box with one corner at the origin, cut into a grid of cells.

    File order: with n = `cells`, the vertex at grid position (i, j[, k]) is number
    i + (n₀ + 1) j [+ (n₀ + 1)(n₁ + 1) k], so x runs fastest. A rectangle of the grid is cut
    into 2 triangles along its rising diagonal, a cuboid into 6 tetrahedra around its diagonal
    from the lowest to the highest corner; those of grid cell (i, j[, k]) follow one another,
    and x again runs fastest. Quadrilaterals and hexahedra are the grid cells themselves; with
    quadrilaterals it is y that runs fastest, as DOLFINx has it.

    Args:
        comm: Communicator over which the mesh is distributed.
        size: Edge lengths, d = 2 or 3 of them. [m]
        cells: Number of grid cells along each edge.
        cell: A name in `CELLS`; by default triangles or tetrahedra.

    Raises:
        MeshError: Not 2 or 3 sizes, as many cell counts, one that is not positive, or an unknown
            kind of cell.
    """
    d = len(size)
    if d not in (2, 3) or len(cells) != d:
        raise MeshError(
            f"box: size and cells must both have 2 or both 3 entries, not {d} and {len(cells)}"
        )
    if not all(math.isfinite(s) and s > 0 for s in size):
        raise MeshError(f"box: size must be positive lengths, not {list(size)}")
    if not all(n >= 1 for n in cells):
        raise MeshError(f"box: cells must be 1 or more along each edge, not {list(cells)}")
    if cell is None:
        cell = CELLS[d][0]
    if cell not in CELLS[d]:
        raise MeshError(f"box: cell must be {' or '.join(CELLS[d])} in {d}D, not {cell!r}")
    kind, ghosts = mesh.CellType[cell], mesh.GhostMode.shared_facet
    corners = np.array([np.zeros(d), size], dtype=np.float64)
    if d == 2:
        msh = mesh.create_rectangle(comm, corners, cells, kind, ghost_mode=ghosts)
    else:
        msh = mesh.create_box(comm, list(corners), cells, kind, ghost_mode=ghosts)
    local = np.arange(len(msh.topology.original_cell_index), dtype=np.int32)
    return Body(msh, mesh.meshtags(msh, d, local, np.zeros(len(local), dtype=np.int32)))
