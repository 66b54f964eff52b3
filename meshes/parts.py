"""Parts of a body that no vertex joins, and which of them the boundary clauses hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import scipy
from dolfinx import la

from meshes.body import Body
from meshes.selection import select
from meshes.where import Where


@dataclass(frozen=True)
class Part:
    """A part of a body: its cells hang together by their vertices, and with no others.

    Attributes:
        cells: Their number.
        first: The least of their file numbers.
        low: Least coordinates [m].
        high: Largest coordinates [m].
        held: Whether a boundary clause has a vertex of it.
    """

    cells: int
    first: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    held: bool

    def __str__(self) -> str:
        """Where it is."""
        spans = ", ".join(
            f"{axis} from {a:g} to {b:g}"
            for axis, a, b in zip("xyz", self.low, self.high, strict=False)
        )
        cells = f"{self.cells} cells" if self.cells > 1 else "1 cell"
        return f"{cells}, the first is cell {self.first}; {spans}"


def joined(cells: npt.NDArray[np.integer], vertices: int) -> tuple[int, npt.NDArray[np.int32]]:
    """Number the sets of vertices that cells join.

    Args:
        cells: Vertices of each cell, shape (cells, vertices of a cell).
        vertices: Number of vertices.

    Returns:
        The number of sets, and the set of each vertex.
    """
    rows = np.repeat(cells[:, 0], cells.shape[1] - 1)
    pairs = (rows, cells[:, 1:].ravel())
    graph = scipy.sparse.coo_array(
        (np.ones(len(rows), dtype=np.int8), pairs), shape=(vertices, vertices)
    )
    count, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), labels


def connected_parts(body: Body, clauses: Iterable[Where] = ()) -> list[Part]:
    """The parts of a body in the order of their first cells, the same on all ranks. Collective.

    Args:
        body: The body.
        clauses: Those of the boundary, which hold the parts that they have vertices of.

    Raises:
        MeshError: A clause names what the body does not have, see `Body.dofs`.
    """
    msh, comm = body.mesh, body.mesh.comm
    geometry, d = msh.geometry, msh.geometry.dim
    part = _parts_of_vertices(body)
    size = 1 + comm.allreduce(int(part.max(initial=-1)), op=MPI.MAX)

    held = np.zeros(size, dtype=np.int32)
    for where in clauses:
        found = select(msh, body.groups, where)
        held[part[found.touched(msh)]] = 1
    owned = len(body.file_cells)
    of_cells = part[geometry.dofmaps[0][:owned, 0]]
    first = np.full(size, body.num_cells, dtype=np.int64)
    np.minimum.at(first, of_cells, body.file_cells)
    low, high = np.full((size, d), np.inf), np.full((size, d), -np.inf)
    np.minimum.at(low, part, geometry.x[:, :d])
    np.maximum.at(high, part, geometry.x[:, :d])
    cells = comm.allreduce(np.bincount(of_cells, minlength=size))
    holding = comm.allreduce(held)
    first = np.min(comm.allgather(first), axis=0)
    low, high = np.min(comm.allgather(low), axis=0), np.max(comm.allgather(high), axis=0)
    return [
        Part(
            int(cells[k]),
            int(first[k]),
            tuple(low[k].tolist()),
            tuple(high[k].tolist()),
            bool(holding[k]),
        )
        for k in np.argsort(first)
    ]


def told_parts(parts: Sequence[Part]) -> str:
    """A line on a body in several parts, or nothing."""
    if len(parts) < 2:
        return ""
    loose = [(k, part) for k, part in enumerate(parts, 1) if not part.held]
    told = "; ".join(f"nothing holds part {k} ({part})" for k, part in loose[:3])
    if len(loose) > 3:
        told += f"; nor {len(loose) - 3} more"
    return (
        f"the body is in {len(parts)} parts that share no vertex, so that each moves by itself; "
        + (told or "the boundary clauses hold each of them")
    )


def _parts_of_vertices(body: Body) -> npt.NDArray[np.int32]:
    """The part of each local vertex, numbered over all ranks. Collective."""
    geometry, comm = body.mesh.geometry, body.mesh.comm
    count, label = joined(geometry.dofmaps[0], len(geometry.x))
    counts = comm.allgather(count)
    label = label + sum(counts[: comm.rank])
    # A ghost vertex has a label here and one on the rank that owns it: both are one part.
    theirs = la.vector(geometry.index_map(), 1, dtype=np.int32)
    theirs.array[:] = label
    theirs.scatter_forward()
    pairs = np.unique(np.stack([label, theirs.array], axis=1), axis=0)
    every = np.concatenate(comm.allgather(pairs))
    _, merged = joined(every, sum(counts))
    return np.asarray(merged[label], dtype=np.int32)
