"""The blocks of the condensed matrix, and where cells add to them."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from solvers.engine.rest import Rest
from solvers.layout import BlockLayout

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


def prescribed_dofs(f: fem.Function, bcs: Sequence[fem.DirichletBC]) -> Ints:
    """Local dofs of a field, ghosts included, with Dirichlet conditions."""
    own = [bc for bc in bcs if f.function_space._cpp_object.contains(bc.function_space)]
    return np.concatenate([*(bc.dof_indices()[0] for bc in own), np.zeros(0, dtype=np.int32)])


class Couplings:
    """The blocks of a matrix on shared fields that this rank's cells contribute to.

    Attributes:
        blocks: Their values, for each pair of fields of shape (couplings, components, components).
        places: Which block each pair of nodes of a cell adds to, shape (cells, nodes, nodes).
    """

    def __init__(
        self, fields: Sequence[fem.Function], prescribed: Sequence[Ints], rest: Rest
    ) -> None:
        """Find the entries in rows and columns of prescribed dofs, which stay zero."""
        self._layout = BlockLayout(fields)
        self._fields = fields
        self.blocks: list[Floats] = []
        self.places: list[Ints] = []
        marked = []
        for f, dofs in zip(fields, prescribed, strict=True):
            marked.append(np.zeros(len(f.x.array), dtype=bool))
            marked[-1][dofs] = True
        rows: list[npt.NDArray[np.int64]] = []
        columns: list[npt.NDArray[np.int64]] = []
        zeros: list[npt.NDArray[np.int64]] = []
        first = 0
        for i, f in enumerate(fields):
            for j, g in enumerate(fields):
                pairs, places = _pairs(f, g, self._layout.cells)
                a, b = f.function_space.dofmap.bs, g.function_space.dofmap.bs
                shape = len(pairs), a, b
                in_row = pairs[:, 0, None, None] * a + np.arange(a)[:, None]
                in_column = pairs[:, 1, None, None] * b + np.arange(b)
                for numbers, field, dofs in ((rows, i, in_row), (columns, j, in_column)):
                    local = np.broadcast_to(dofs, shape).ravel().astype(np.int32)
                    numbers.append(self._layout.numbers(field, local))
                none = marked[i][in_row] | marked[j][in_column]
                zeros.append(first + np.flatnonzero(none))
                first += none.size
                self.blocks.append(np.zeros(shape))
                self.places.append(places)
        self._zeros = np.concatenate(zeros)
        # The rest's own entries, then ones for Dirichlet conditions.
        rest_rows, rest_columns = rest.pattern()
        ones = [
            self._layout.numbers(
                k, dofs[dofs < self._layout.offsets[k + 1] - self._layout.offsets[k]]
            )
            for k, dofs in enumerate(prescribed)
        ]
        diagonal = self._diagonal = np.unique(np.concatenate(ones))
        self._rows = np.concatenate([*rows, rest_rows, diagonal])
        self._columns = np.concatenate([*columns, rest_columns, diagonal])

    def create_matrix(self) -> PETSc.Mat:
        """Create a matrix for `insert`. Collective."""
        single = len(self._fields) == 1
        bs = self._fields[0].function_space.dofmap.index_map_bs if single else 1
        K = PETSc.Mat().create(self._layout.comm)
        K.setSizes(((self._layout.offsets[-1], None),) * 2, bsize=bs)
        K.setType(PETSc.Mat.Type.AIJ)
        K.setPreallocationCOO(
            self._rows.astype(PETSc.IntType, copy=False),
            self._columns.astype(PETSc.IntType, copy=False),
        )
        self._values: Floats = np.zeros(len(self._rows))
        self._values[len(self._rows) - len(self._diagonal) :] = 1.0
        del self._rows, self._columns
        return K

    def insert(self, K: PETSc.Mat, rest: Floats) -> None:
        """Put the sum over the ranks into K, with the rest's values. Collective."""
        first = 0
        for blocks in self.blocks:
            self._values[first : first + blocks.size] = blocks.ravel()
            first += blocks.size
        self._values[self._zeros] = 0.0
        self._values[first : first + len(rest)] = rest
        K.setValuesCOO(self._values, PETSc.InsertMode.INSERT)


def _pairs(f: fem.Function, g: fem.Function, cells: int) -> tuple[Ints, Ints]:
    """Pairs of nodes of two fields in a common cell, and where those of each cell are."""
    rows, columns = (h.function_space.dofmap.list[:cells].astype(np.int64) for h in (f, g))
    stride = int(columns.max(initial=0)) + 1
    keys = rows[:, :, None] * stride + columns[:, None, :]
    pairs, places = np.unique(keys, return_inverse=True)
    couplings = np.stack(np.divmod(pairs, stride), axis=1).astype(np.int32)
    return couplings, np.ascontiguousarray(places.reshape(keys.shape), dtype=np.int32)
