"""A mesh in memory in the order of its file, and how a body is made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mpi4py import MPI

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
    meshtags,
)

from meshes.body import Body
from meshes.errors import MeshError
from meshes.groups import Group, Integers

_FARTHEST = 1e50  # [m]


@dataclass
class RawMesh:
    """A mesh in memory on one rank, in its own order of vertices and cells."""

    kind: CellType
    points: npt.NDArray[np.float64]  # (vertices, d)
    cells: Integers  # (cells, vertices of a cell), a cell's vertices in DOLFINx's order
    tags: npt.NDArray[np.int32]  # (cells,)
    groups: dict[str | int, Group] = field(default_factory=dict)

    @property
    def simplicial(self) -> bool:
        """Whether the cells are triangles or tetrahedra."""
        return self.cells.shape[1] == self.points.shape[1] + 1


def strange(points: npt.NDArray[np.float64]) -> Integers:
    """Vertices with coordinates that are no numbers, or that have no products in floating point."""
    return np.flatnonzero(~(np.abs(points) < _FARTHEST).all(axis=1))


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


def make_body(comm: MPI.Comm, make: Callable[[], RawMesh]) -> Body:
    """Make a mesh on rank 0 and distribute it from there. Collective.

    Args:
        comm: Communicator over which the mesh is distributed.
        make: Called on rank 0 alone.

    Raises:
        MeshError: On all ranks, what `make` raises.
    """
    raw: RawMesh | None = None
    error: str | None = None
    if comm.rank == 0:
        try:
            raw = make()
        except MeshError as e:
            error = str(e)
    error = comm.bcast(error)
    if error is not None:
        raise MeshError(error)

    name, vertices = comm.bcast(None if raw is None else (raw.kind.name, raw.cells.shape[1]))
    kind = getattr(CellType, name)
    d = cell_dim(kind)
    # Every rank gets the tags of the whole mesh: 4 bytes a cell, far below the mesh itself.
    tags, groups = comm.bcast(None if raw is None else (raw.tags, raw.groups))
    msh = distribute(
        comm,
        kind,
        np.empty((0, vertices), dtype=np.int64) if raw is None else raw.cells,
        np.empty((0, d)) if raw is None else raw.points,
    )
    original = msh.topology.original_cell_index
    local = np.arange(len(original), dtype=np.int32)
    return Body(msh, meshtags(msh, d, local, tags[original]), groups)


def collect(body: Body) -> RawMesh | None:
    """The whole of a body in file order, on rank 0; None elsewhere. Collective."""
    msh = body.mesh
    points = body.gather_points()
    cells = body.gather(body.file_connectivity())
    tags = body.gather(body.cell_tags.values[: len(body.file_cells)])
    if points is None or cells is None or tags is None:
        return None
    return RawMesh(msh.topology.cell_type, points, cells, tags, dict(body.groups))
