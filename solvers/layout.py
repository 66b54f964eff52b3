"""How the unknowns of several fields are numbered in one PETSc vector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from solvers.lifetime import shared_communicator

Ints = npt.NDArray[np.int64]


class BlockLayout:
    """The numbering of DOLFINx's blocked vectors: rank by rank, within a rank field by field.

    Attributes:
        comm: Communicator of the mesh.
        block_sizes: Components that a dof of each field's space has.
        cells: Number of cells this rank owns.
        points: Points of a cell at which the fields after the first live, if all live at the points
            of one quadrature rule; else 1. Unknowns of two points are not coupled.
        offsets: Where each field starts among this rank's owned unknowns; the last entry is their
            number. Shape (fields + 1,).
    """

    def __init__(self, fields: Sequence[fem.Function]) -> None:
        self._dofmaps = [f.function_space.dofmap for f in fields]
        mesh = fields[0].function_space.mesh
        self.comm: MPI.Comm = shared_communicator(mesh.comm)
        self.block_sizes = [m.index_map_bs for m in self._dofmaps]
        self.cells: int = mesh.topology.index_map(mesh.topology.dim).size_local
        widths = {m.list.shape[1] for m in self._dofmaps[1:]}
        pointwise = all(f.function_space.ufl_element().has_custom_quadrature for f in fields[1:])
        self.points: int = widths.pop() if pointwise and len(widths) == 1 else 1
        owned = [m.index_map.size_local * m.index_map_bs for m in self._dofmaps]
        self.offsets: Ints = np.cumsum([0, *owned])
        per_rank = np.array(self.comm.allgather(self.offsets))
        ends = np.cumsum(per_rank[:, -1])
        # Start of each field's segment on each rank in the global numbering, in order.
        self._starts: Ints = (ends - per_rank[:, -1])[:, None] + per_rank[:, :-1]
        # The same in the numbering of each field's own index map.
        sizes = np.diff(per_rank, axis=1)
        self._own_starts: Ints = np.cumsum(sizes, axis=0) - sizes

    def create_vector(self) -> PETSc.Vec:
        """Create a vector of the unknowns, as DOLFINx's of kind "mpi". Collective."""
        owned = np.diff(self.offsets)
        local = [self.local_dofs(f) for f in range(len(owned))]
        ghosts = [
            self.numbers(f, np.arange(owned[f], local[f], dtype=np.int32))
            for f in range(len(owned))
        ]
        x = PETSc.Vec().createGhost(
            np.concatenate(ghosts).astype(PETSc.IntType),
            size=(int(self.offsets[-1]), None),
            comm=self.comm,
        )
        ends = self.offsets[-1] + np.cumsum([0, *map(len, ghosts)])
        x.setAttr("_blocks", (tuple(self.offsets.tolist()), tuple(ends.tolist())))
        return x

    def split(self, owned: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
        """The owned part of a vector as a list of views, one for each field."""
        return np.split(owned, self.offsets[1:-1])

    def fields_of(self, unknowns: Ints) -> Ints:
        """The field that each global unknown belongs to."""
        segment = np.searchsorted(self._starts.ravel(), unknowns, side="right") - 1
        return segment % self._starts.shape[1]

    def own_numbers(self, field: int, unknowns: Ints) -> Ints:
        """Numbers in a field's own global numbering of global unknowns of that field."""
        rank = np.searchsorted(self._starts[:, field], unknowns, side="right") - 1
        return unknowns - self._starts[rank, field] + self._own_starts[rank, field]

    def numbers(self, field: int, dofs: npt.NDArray[np.int32]) -> Ints:
        """Global unknowns of local (owned or ghost) scalar degrees of freedom of a field."""
        own = self.own_global(field, dofs)
        rank = np.searchsorted(self._own_starts[:, field], own, side="right") - 1
        return own - self._own_starts[rank, field] + self._starts[rank, field]

    def own_global(self, field: int, dofs: npt.NDArray[np.int32]) -> Ints:
        """A field's own global numbers of its local (owned or ghost) scalar dofs."""
        dofmap = self._dofmaps[field]
        bs = dofmap.index_map_bs
        blocks, component = np.divmod(dofs, bs)
        numbers: Ints = dofmap.index_map.local_to_global(blocks.ravel().astype(np.int32))
        return numbers.reshape(dofs.shape) * bs + component

    def cell_dofs(self, field: int) -> npt.NDArray[np.int32]:
        """Local scalar dofs of a field on each owned cell, shape (owned cells, dofs a cell)."""
        dofmap = self._dofmaps[field]
        blocks, bs = dofmap.list[: self.cells], dofmap.index_map_bs
        dofs = blocks[:, :, None] * bs + np.arange(bs, dtype=np.int32)
        return dofs.reshape(self.cells, blocks.shape[1] * bs)

    def local_dofs(self, field: int) -> int:
        """Number of scalar dofs of a field on this rank, ghosts included."""
        dofmap = self._dofmaps[field]
        index_map = dofmap.index_map
        return int((index_map.size_local + index_map.num_ghosts) * dofmap.index_map_bs)


def is_local(f: Any) -> bool:
    """Whether cells share no degree of freedom of a field: all of its element's are inside."""
    return not any(dofs for entities in f.ufl_element().entity_dofs[:-1] for dofs in entities)


def require_local(fields: Sequence[fem.Function]) -> None:
    """Insist that every field but the first is local to cells.

    Raises:
        ValueError: One is not.
    """
    for f in fields[1:]:
        if not is_local(f):
            raise ValueError(
                f"the field {f.name} is not local to cells; condensation needs every field but "
                'the first to be discontinuous, or choose solver="direct"'
            )
