r"""Static condensation of the cell-local fields of an assembled Newton system.

The Newton system in a displacement u and cell-local fields l,

    ( J_uu  J_ul ) ( δu )   ( b_u )
    ( J_lu  J_ll ) ( δl ) = ( b_l ),

has a J_ll with one dense block D a cell, or one a quadrature point if all of l lives at such
points, so that with B the rows of J_lu of that cell or point

    K = J_uu - Σ_K Bᵀ D⁻¹ B,   K δu = b_u - Σ_K Bᵀ D⁻¹ b_l,   δl = D⁻¹ (b_l - B δu).

K has the size and the sparsity of a displacement method's matrix. For the seed's system this does
eqs. (36) and (41) in one elimination. Everything is read off the assembled Jacobian of whatever
energy there is: a row of a cell-local unknown couples with the dofs of its own cell alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

from solvers.layout import BlockLayout, Ints

Floats = npt.NDArray[np.float64]
Group = tuple[int, ...]


class Condensation(Protocol):
    """Elimination of the cell-local unknowns of a Newton system.

    Attributes:
        K: The condensed matrix.
        definite: Whether only a positive definite K will do: there are stand-ins for others.
    """

    K: PETSc.Mat

    @property
    def definite(self) -> bool:
        """Whether only a positive definite K will do."""

    def update(self) -> Sequence[int]:
        """Condense the current Jacobian into K. Collective.

        Returns:
            Where there is no condensed system, the numbers of the fields whose local block is
            singular, the same on all ranks.
        """

    def project(self) -> bool:
        """Put a positive semi-definite stand-in into K, if there is one. Collective."""

    def eliminate(self, b: Floats, g: Sequence[Floats]) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local dofs of shared fields, for this rank's unknowns b."""

    def recover(self, b: Floats, u: Sequence[Floats], x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x; u on local dofs."""


class LocalBlocks:
    """Reads the blocks of cell-local fields off a nested Jacobian, and fills matrices like them.

    A part is an owned cell, or a quadrature point of one if all local fields live at such points.

    Attributes:
        parts: How many this rank has.
        dofs: Of each field the local dofs on a part, in ascending global order, in which entries
            stand in a row of a matrix; shape (parts, n).
    """

    def __init__(self, layout: BlockLayout, A: PETSc.Mat) -> None:
        """Work out where each entry goes; the sparsity of A never changes.

        Args:
            layout: Numbering of the unknowns.
            A: The Jacobian as a nest, assembled once.
        """
        self.layout, self._A = layout, A
        self.parts = layout.cells * layout.points
        self.dofs: list[npt.NDArray[np.int32]] = []
        self._numbers: list[Ints] = []
        for f in range(len(layout.offsets) - 1):
            dofs = layout.cell_dofs(f)
            if f == 0:
                dofs = np.repeat(dofs, layout.points, axis=0)
            else:  # on a cell the points come one after the other
                dofs = dofs.reshape(self.parts, dofs.shape[1] // layout.points)
            numbers = layout.own_global(f, dofs)
            order = np.argsort(numbers, axis=1)
            self.dofs.append(np.take_along_axis(dofs, order, axis=1))
            self._numbers.append(np.take_along_axis(numbers, order, axis=1))
        every = range(len(self.dofs))
        self._targets = {
            (f, g): self._find_targets(f, g) for f in every[1:] for g in every if self.block(f, g)
        }
        indptr, columns, _ = self.block(0, 0).getValuesCSR()
        first, _ = self.block(0, 0).getOwnershipRange()
        rows = np.repeat(np.arange(first, first + len(indptr) - 1), np.diff(indptr))
        self._uu_sparsity = rows, columns

    def block(self, f: int, g: int) -> PETSc.Mat:
        """A block of the Jacobian; false if it is empty."""
        return self._A.getNestSubMatrix(f, g)

    def place(self, f: int, fields: Group) -> slice:
        """Where the unknowns of field f stand among those of some fields on a part."""
        start = sum(self.dofs[g].shape[1] for g in fields[: fields.index(f)])
        return slice(start, start + self.dofs[f].shape[1])

    def read(self) -> tuple[Floats, Floats]:
        """D and B of all cell-local fields, shapes (parts, n, n) and (parts, n, n_u)."""
        fields = tuple(range(1, len(self.dofs)))
        n = self.place(fields[-1], fields).stop
        D = np.zeros((self.parts, n, n))
        B = np.zeros((self.parts, n, self.dofs[0].shape[1]))
        for (f, g), (entries, targets) in self._targets.items():
            width = self.dofs[g].shape[1]
            values = np.zeros(self.dofs[f].size * width)
            values[targets] = self.block(f, g).getValuesCSR()[2][entries]
            into = B if g == 0 else D
            columns = slice(None) if g == 0 else self.place(g, fields)
            into[:, self.place(f, fields), columns] = values.reshape(-1, width)[self.dofs[f]]
        return D, B

    def matrix(self, f: int, g: int) -> PETSc.Mat:
        """An empty matrix for `fill`, in the fields' own numbering."""
        numbers = [self._numbers[f], self._numbers[g]]
        if f == g == 0:  # the parts of a cell are summed first
            numbers = [n[:: self.layout.points] for n in numbers]
        shape = [n.shape[1] for n in numbers]
        rows = np.repeat(numbers[0], shape[1], axis=1).ravel()
        columns = np.tile(numbers[1], (1, shape[0])).ravel()
        if f == g == 0:
            rows = np.concatenate([self._uu_sparsity[0], rows])
            columns = np.concatenate([self._uu_sparsity[1], columns])
        owned, bs = np.diff(self.layout.offsets), self.layout.block_sizes
        matrix = PETSc.Mat().create(self.layout.comm)
        matrix.setSizes(((owned[f], None), (owned[g], None)))
        matrix.setBlockSizes(bs[f], bs[g])
        matrix.setType("aij")
        matrix.setPreallocationCOO(
            rows.astype(PETSc.IntType, copy=False), columns.astype(PETSc.IntType, copy=False)
        )
        return matrix

    def fill(self, matrix: PETSc.Mat, f: int, g: int, values: Floats) -> None:
        """Put parts' values, shape (parts, unknowns of f, of g), into a matrix.

        The displacement's own block has J_uu added; its values are of shape (owned cells, n_u,
        n_u).
        """
        pieces = [values.ravel()]
        if f == g == 0:
            pieces.insert(0, self.block(0, 0).getValuesCSR()[2])
        matrix.setValuesCOO(np.concatenate(pieces), PETSc.InsertMode.INSERT)

    def product_by_cell(self, B: Floats, other: Floats) -> Floats:
        """Σ Bᵀ C over the points of each cell, shape (owned cells, n_u, n_u)."""
        # Not einsum, which does not call BLAS for a product in each cell.
        cells = self.layout.cells, self.layout.points * B.shape[1], B.shape[2]
        product: Floats = B.reshape(cells).transpose(0, 2, 1) @ other.reshape(cells)
        return product

    def _find_targets(self, f: int, g: int) -> tuple[Ints | slice, Ints | slice]:
        """Which entries of a block to read, and where they go in an array.

        The array has a row for each unknown of f, with the unknowns of g on the part of f.
        """
        indptr, columns, _ = self.block(f, g).getValuesCSR()
        rows, width = len(indptr) - 1, self.dofs[g].shape[1]
        if len(columns) == rows * width:
            return slice(None), slice(None)  # they fill it in order
        part = np.empty(rows, dtype=np.int64)
        part[self.dofs[f]] = np.arange(self.parts)[:, None]
        row = np.repeat(np.arange(rows), np.diff(indptr))
        same = self._numbers[g][part[row]] == columns[:, None]
        # There are entries, all zero, between the points of a cell.
        entries = np.flatnonzero(same.any(axis=1))
        targets: Ints = row[entries] * width + np.argmax(same[entries], axis=1)
        return entries, targets


class CellBlocks:
    """Eliminates all cell-local fields at once, and assembles K."""

    definite = False

    def __init__(self, blocks: LocalBlocks) -> None:
        """Make the matrix.

        Args:
            blocks: The reader.
        """
        self._blocks = blocks
        layout = blocks.layout
        local = range(1, len(blocks.dofs))
        # Rows of the local unknowns of a part among this rank's unknowns, and their fields.
        self._rows: Ints = np.hstack([blocks.dofs[f] + layout.offsets[f] for f in local])
        self._fields: Ints = np.repeat(local, [blocks.dofs[f].shape[1] for f in local])
        self._u_dofs, self._local_u_dofs = blocks.dofs[0], layout.local_dofs(0)
        self.K = blocks.matrix(0, 0)

    def update(self) -> Sequence[int]:
        """Eliminate the local unknowns from the assembled Jacobian, into K."""
        D, self._B = self._blocks.read()
        self._inverse, null = _inverse(D)
        here = self._fields[np.flatnonzero(null)]
        if singular := set().union(*self._blocks.layout.comm.allgather(set(here.tolist()))):
            return sorted(singular)
        condensed = -self._blocks.product_by_cell(self._B, self._inverse @ self._B)
        self._blocks.fill(self.K, 0, 0, condensed)
        return ()

    def project(self) -> bool:
        """The parts of J_uu are summed already, so that no cell's can be projected."""
        return False

    def eliminate(self, b: Floats, g: Sequence[Floats]) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local dofs of shared fields, for this rank's unknowns b."""
        D_b = self._inverse @ b[self._rows][:, :, None]
        parts = self._B.transpose(0, 2, 1) @ D_b
        g[0][:] -= np.bincount(self._u_dofs.ravel(), parts.ravel(), self._local_u_dofs)

    def recover(self, b: Floats, u: Sequence[Floats], x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x; u on local dofs."""
        right = b[self._rows][:, :, None] - self._B @ u[0][self._u_dofs][:, :, None]
        x[self._rows] = (self._inverse @ right)[:, :, 0]


class NothingToEliminate:
    """The elimination of a problem in the displacement alone, whose Jacobian is K itself."""

    definite = False

    def __init__(self, A: PETSc.Mat) -> None:
        self.K = A

    def update(self) -> Sequence[int]:
        """Nothing."""
        return ()

    def project(self) -> bool:
        """The cells' parts are summed already, so that none can be projected."""
        return False

    def eliminate(self, b: Floats, g: Sequence[Floats]) -> None:
        """Nothing."""

    def recover(self, b: Floats, u: Sequence[Floats], x: Floats) -> None:
        """Nothing."""


def _inverse(D: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Inverses of the parts' blocks, and which of the unknowns are in a null space of one."""
    resolved = 1.0 / np.finfo(float).eps
    nothing = np.zeros(D.shape[1], dtype=bool)
    try:
        inverse: Floats = np.linalg.inv(D)
        condition = np.linalg.norm(D, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
        suspects = D[condition > resolved]
    except np.linalg.LinAlgError:
        inverse, suspects = D, D[np.isfinite(D).all(axis=(1, 2))]
    if not len(suspects):
        return inverse, nothing
    _, values, vectors = np.linalg.svd(suspects)
    null = vectors[values * resolved <= 10.0 * values[:, :1]]
    return inverse, (np.abs(null) > 1e-3).any(axis=0)
