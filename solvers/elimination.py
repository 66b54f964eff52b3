r"""Elimination of cell-local fields one after the other, each Schur complement assembled.

The Newton system in a displacement u and cell-local fields is eliminated group by group. A group g
of fields has one dense block D_gg a cell, or one a quadrature point, and leaves on the other
cell-local fields r and on u

    D_rr - D_rg D_gg⁻¹ D_gr,   B_r - D_rg D_gg⁻¹ B_g,   J_uu - Σ_K B_gᵀ D_gg⁻¹ B_g,

with B the cell's rows in the columns of u. For the seed's system (35) with S as the first group
this is the reduced system (41) with M̃ (39) and J̃ (40), and Λ as the second leaves the condensed
matrix.
All of it is read off the assembled blocks of the Jacobian, whatever the energy is, and each Schur
complement has the sparsity of the blocks that it replaces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from solvers.condensation import Floats, Group, LocalBlocks
from solvers.layout import BlockLayout, Ints

SINGULAR = 1e8
"""Condition number of a scaled local block past which a field is not eliminated on its own."""


@dataclass(frozen=True)
class Reduced:
    """The cells' part of a Schur complement.

    Attributes:
        fields: Numbers of the cell-local fields that are left, in ascending order.
        group: Those of them that go next.
        D: Blocks of `fields`, shape (parts, n, n) with n unknowns on a part.
        B: Their rows in the columns of the displacement, shape (parts, n, n_u).
        uu: What the elimination has added to J_uu, shape (owned cells, n_u, n_u).
        inverse: D_gg⁻¹ of the group, shape (parts, m, m).
    """

    fields: Group
    group: Group
    D: Floats
    B: Floats
    uu: Floats
    inverse: Floats


class Elimination:
    """Schur complements of a nested Jacobian, cell by cell or point by point.

    Attributes:
        blocks: The reader of the Jacobian, for which a part is one of either.
        layout: Numbering of the unknowns.
        groups: The fields that are eliminated together, in order.
    """

    def __init__(self, blocks: LocalBlocks) -> None:
        """Choose the groups.

        A field is eliminated on its own if its local blocks allow it, the first such field first.
        What is left when there is none goes as one group.

        Args:
            blocks: The reader of the Jacobian, assembled.
        """
        self.blocks, self.layout = blocks, blocks.layout
        self.groups = self._choose_groups()
        self.tell_block_sizes(blocks.block)

    def places(self, group: Group, fields: Group) -> Ints:
        """Where the unknowns of a group of fields stand among those of some fields on a cell."""
        return np.concatenate(
            [np.r_[self.blocks.place(f, fields)] for f in group] or [np.zeros(0, dtype=np.int64)]
        )

    def rows(self, group: Group) -> Ints:
        """This rank's unknowns of a group that are on each part, shape (parts, m).

        They count from 0 for the first owned unknown of the first field of the group.
        """
        owned = np.diff(self.layout.offsets)
        starts = np.cumsum([0, *owned[list(group)]])
        return np.hstack([self.blocks.dofs[f] + s for f, s in zip(group, starts, strict=False)])

    def tell_block_sizes(self, block: Callable[[int, int], PETSc.Mat | None]) -> None:
        """Tell the matrices of groups of one field how large their blocks are, for VPBJACOBI.

        PBJACOBI would go by the block size, but in PETSc 3.25 it keeps the inverses of old blocks.
        """
        for group in filter(self.is_point_block, self.groups):
            if matrix := block(group[0], group[0]):
                size = self.layout.block_sizes[group[0]]
                sizes = np.full(self.blocks.parts, size, dtype=PETSc.IntType)
                matrix.setVariableBlockSizes(sizes)

    def is_point_block(self, group: Group) -> bool:
        """Whether the blocks of a group are the point blocks of one field's matrix."""
        return (
            len(group) == 1
            and self.blocks.dofs[group[0]].shape[1] == self.layout.block_sizes[group[0]]
        )

    def reductions(self) -> Iterator[Reduced]:
        """Eliminate from the current Jacobian: what there is before each group, and at the end."""
        fields = tuple(range(1, len(self.blocks.dofs)))
        D, B = self.blocks.read()
        uu = np.zeros((self.layout.cells, B.shape[2], B.shape[2]))
        for group in self.groups:
            rest = tuple(f for f in fields if f not in group)
            g, r = (_views(self.places(part, fields)) for part in (group, rest))
            D_g, D_r, B_g = D[:, g], D[:, r], B[:, g]
            inverse = _inverse(D_g[:, :, g])
            yield Reduced(fields, group, D, B, uu, inverse)
            D_rg = D_r[:, :, g]
            from_u, from_r = inverse @ B_g, inverse @ D_g[:, :, r]
            # What was yielded has been used.
            uu -= self.blocks.product_by_cell(B_g, from_u)
            D, B = D_r[:, :, r] - D_rg @ from_r, B[:, r] - D_rg @ from_u
            fields = rest
        yield Reduced((), (), D, B, uu, D)

    def _choose_groups(self) -> tuple[Group, ...]:
        fields = tuple(range(1, len(self.blocks.dofs)))
        D, _ = self.blocks.read()
        groups: list[Group] = []
        while fields:
            for f in fields:
                g = np.r_[self.blocks.place(f, fields)]
                if self._condition(D[:, g[:, None], g]) < SINGULAR:
                    break
            else:
                return (*groups, fields)
            rest = tuple(r for r in fields if r != f)
            r = self.places(rest, fields)
            D_gr = D[:, g[:, None], r]
            D = D[:, r[:, None], r] - D[:, r[:, None], g] @ np.linalg.solve(
                D[:, g[:, None], g], D_gr
            )
            groups.append((f,))
            fields = rest
        return tuple(groups)

    def _condition(self, blocks: Floats) -> float:
        """The largest condition number of any cell's block on any rank."""
        try:
            inverse = np.linalg.inv(blocks)
            condition = np.linalg.norm(blocks, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
            worst = float(np.nan_to_num(condition, nan=np.inf).max(initial=0.0))
        except np.linalg.LinAlgError:
            worst = np.inf
        return float(self.layout.comm.allreduce(worst, op=MPI.MAX))


class SchurComplements:
    """The Jacobian and its Schur complements, as matrices for nested field splits.

    Attributes:
        systems: The systems in order: the Jacobian regrouped, each Schur complement, the condensed
            matrix. All but the last are nests of two blocks each way, the group's and the rest's.
        parts: Of each system but the last the fields of the group and of the rest.
        splits: Their index sets in the system.
        inverses: D_gg⁻¹ of each group, shape (parts, m, m).
    """

    def __init__(self, elimination: Elimination) -> None:
        """Make and fill the matrices."""
        self._elimination = elimination
        layout = elimination.layout
        self.systems: list[PETSc.Mat] = []
        self.parts: list[tuple[Group, Group]] = []
        self.splits: list[list[PETSc.IS]] = []
        self.inverses: list[Floats] = []
        self._blocks: list[dict[tuple[int, int], PETSc.Mat]] = []
        fields: Group = tuple(range(len(layout.offsets) - 1))
        block: Callable[[int, int], PETSc.Mat | None] = elimination.blocks.block
        for group in elimination.groups:
            rest = tuple(f for f in fields if f not in group)
            self.parts.append((group, rest))
            self.splits.append([_index_set(layout, part, fields) for part in (group, rest)])
            self.systems.append(_nest((group, rest), block, self.splits[-1], layout))
            made = {(f, g): elimination.blocks.matrix(f, g) for f in rest for g in rest}
            self._blocks.append(made)
            block = _getter(made)
            elimination.tell_block_sizes(block)
            fields = rest
        self.systems.append(block(0, 0))
        self.update()

    @property
    def K(self) -> PETSc.Mat:
        """The condensed matrix."""
        return self.systems[-1]

    def update(self) -> None:
        """Eliminate from the current Jacobian."""
        reductions = self._elimination.reductions()
        self.inverses[:] = [next(reductions).inverse]
        for blocks, reduced in zip(self._blocks, reductions, strict=True):
            for (f, g), matrix in blocks.items():
                self._elimination.blocks.fill(matrix, f, g, self._part(reduced, f, g))
            self.inverses.append(reduced.inverse)
        # A nest has to be told that its blocks have changed.
        for system in self.systems[:-1]:
            system.assemble()

    def _part(self, reduced: Reduced, f: int, g: int) -> Floats:
        if f == g == 0:
            return reduced.uu
        if f == 0:
            return self._part(reduced, g, f).transpose(0, 2, 1)
        rows = self._elimination.blocks.place(f, reduced.fields)
        if g == 0:
            return reduced.B[:, rows]
        return reduced.D[:, rows, self._elimination.blocks.place(g, reduced.fields)]


class DiagonalBlocks:
    """The diagonal blocks that elimination leaves, made positive definite cell by cell.

    Attributes:
        systems: One matrix with the blocks |D_gg| of each group and the condensed matrix K, which
            is taken as it is.
        parts: The fields of each block.
        splits: Their index sets, in a list of one list.
        inverses: |D_gg|⁻¹ of each group, shape (parts, m, m).
        K: The condensed matrix.
    """

    def __init__(self, elimination: Elimination) -> None:
        """Make and fill the matrices."""
        self._elimination = elimination
        layout = elimination.layout
        self.parts: list[tuple[Group, ...]] = [(*elimination.groups, (0,))]
        fields: Group = tuple(range(len(layout.offsets) - 1))
        self.splits = [[_index_set(layout, part, fields) for part in self.parts[0]]]
        self.inverses: list[Floats] = []
        self._blocks = {
            (f, g): elimination.blocks.matrix(f, g)
            for part in self.parts[0]
            for f in part
            for g in part
        }
        elimination.tell_block_sizes(_getter(self._blocks))
        self.K = self._blocks[0, 0]
        self.systems = [_nest(self.parts[0], _getter(self._blocks), self.splits[0], layout)]
        self.update()

    def update(self) -> None:
        """Eliminate from the current Jacobian."""
        self.inverses.clear()
        for reduced in self._elimination.reductions():
            if not reduced.group:
                self._elimination.blocks.fill(self.K, 0, 0, reduced.uu)
                break
            g = self._elimination.places(reduced.group, reduced.fields)
            block, inverse = _absolute(reduced.D[:, g[:, None], g])
            self.inverses.append(inverse)
            place = self._elimination.blocks.place
            for f in reduced.group:
                for h in reduced.group:
                    part = block[:, place(f, reduced.group), place(h, reduced.group)]
                    self._elimination.blocks.fill(self._blocks[f, h], f, h, part)
        self.systems[0].assemble()


def _views(places: Ints) -> slice | Ints:
    """An index for places that makes a view, not a copy, if they follow one another."""
    if len(places) and np.all(np.diff(places) == 1):
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


def _inverse(blocks: Floats) -> Floats:
    """Inverses; pseudo-inverses if one is singular, for the Krylov method to make up for."""
    try:
        inverse: Floats = np.linalg.inv(blocks)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(blocks, hermitian=True)
    return inverse


def _absolute(blocks: Floats) -> tuple[Floats, Floats]:
    """|D| and |D|⁻¹ of symmetric blocks: the same eigenvectors, absolute eigenvalues."""
    values, vectors = np.linalg.eigh(blocks)
    values = np.abs(values)[:, None, :]
    transposed = vectors.transpose(0, 2, 1)
    return vectors * values @ transposed, vectors / values @ transposed


def _getter(
    blocks: Mapping[tuple[int, int], PETSc.Mat],
) -> Callable[[int, int], PETSc.Mat | None]:
    return lambda f, g: blocks.get((f, g))


def _index_set(layout: BlockLayout, part: Group, fields: Group) -> PETSc.IS:
    """The unknowns of a part of the fields of a system."""
    starts = np.cumsum([0, *np.diff(layout.offsets)[list(fields)]])
    first = sum(layout.comm.allgather(int(starts[-1]))[: layout.comm.rank])
    places = [np.arange(starts[k], starts[k + 1]) for k, f in enumerate(fields) if f in part]
    unknowns = first + np.concatenate(places)
    return PETSc.IS().createGeneral(unknowns.astype(PETSc.IntType), comm=layout.comm)


def _nest(
    parts: Sequence[Group],
    block: Callable[[int, int], PETSc.Mat | None],
    splits: Sequence[PETSc.IS],
    layout: BlockLayout,
) -> PETSc.Mat:
    """A nest of parts, whose blocks are nests of fields where a part has several."""
    owned = np.diff(layout.offsets)

    def zero(f: int, g: int) -> PETSc.Mat:
        # PETSc cannot tell the size of a nest's row or column that has no matrix at all.
        matrix = PETSc.Mat().createAIJ(
            ((owned[f], None), (owned[g], None)), nnz=0, comm=layout.comm
        )
        matrix.assemble()
        return matrix

    def sub(rows: Group, columns: Group) -> PETSc.Mat:
        blocks = [[block(f, g) or zero(f, g) for g in columns] for f in rows]
        if len(rows) == len(columns) == 1:
            return blocks[0][0]
        return PETSc.Mat().createNest(blocks, comm=layout.comm)

    blocks = [[sub(rows, columns) for columns in parts] for rows in parts]
    return PETSc.Mat().createNest(blocks, isrows=splits, iscols=splits, comm=layout.comm)
