"""The Newton system of an energy, its larger part evaluated point by point in compiled code."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la

from forms.spaces import zeros
from solvers.condensation import Condensation
from solvers.engine.couplings import Couplings, prescribed_dofs
from solvers.engine.density import take_apart
from solvers.engine.kernel import Kernel
from solvers.engine.rest import Rest
from solvers.engine.slots import NotPointwise
from solvers.layout import BlockLayout, is_local
from solvers.scaling import Unknowns
from solvers.systems import cell_data, forget_traversals

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

MOST_RELAXATIONS = 30
"""Iterations of Newton's method for the local unknowns of a cell."""

MOST_HALVINGS = 50
"""Of the way of the local unknowns of a cell to where the energy has no value."""


class _Unassembled:
    """The block Jacobian, which nobody needs.

    But PETSc multiplies by it after a line search that failed, to see whether that was at a minimum
    of the residual. It is not told.
    """

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """No product."""
        y.set(np.nan)


class EngineProblem:
    """The callbacks and vectors of a `dolfinx.fem.petsc.NonlinearProblem`, with the engine.

    Attributes:
        fields: The unknowns.
        unknowns: The same as a vector, and their units.
        layout: Their numbering.
        kernels: The compiled parts of the energy.
        shared: Which of them the condensed matrix is of: those that are not local to cells.
        solver: The SNES.
        x: Unknowns, in DOLFINx's blocked layout.
        b: Residual.
        A: The Jacobian: the condensed matrix itself without cell-local fields, else a stand-in for
            the block system, which is only ever solved with.
        K: The condensed matrix, in the fields' own units times their scales.
        data: Per-cell data in the part of the energy that DOLFINx assembles.
        symmetric: Whether the Jacobian is.
        descends: Whether the energy, of positions alone, says all of the system.
        projection: 0 for the exact tangent; 1 for the cells' part made positive semi-definite by
            raising negative eigenvalues to zero, 2 by their absolute values; 3 for a multiple of
            the identity in its place at each point, that of the largest diagonal entry.
        marks: Cells of this rank, ghosts included, that projection is confined to, or None.
        inertia: How many times the part without gradients, such as inertia, counts in K.
        stand_in: Puts the n-th stand-in for the tangent into K, if there is one, where that is not
            positive definite; by default the first is the positive semi-definite one.
        singular: Fields whose local block was singular at the last condensation, on any rank.
    """

    def __init__(
        self,
        energy: ufl.Form,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC],
        prefix: str,
        *,
        work: ufl.Form | None = None,
    ) -> None:
        """Compile the energy. Collective.

        Args:
            energy: The energy [J].
            fields: The unknowns, the displacement first.
            bcs: Dirichlet conditions on fields that are not local to cells.
            prefix: Options prefix of the SNES.
            work: Virtual work [J] on a test function of the first field, or None.

        Raises:
            NotPointwise: The energy is no function of numbers known at a point.
        """
        densities, rest = take_apart(energy, fields)
        if not densities:
            raise NotPointwise("it has no gradients of fields")
        self.fields = tuple(fields)
        self.symmetric = work is None
        self.projection, self.inertia = 0, 1.0
        self.marks: npt.NDArray[np.int8] | None = None
        self.kernels = [Kernel(density, fields) for density in densities]
        self.shared = [k for k, f in enumerate(fields) if not is_local(f)]
        # With a pressure beside the displacement a state of rest is no minimum.
        self.descends = work is None and len(self.shared) == 1
        self._shared = [fields[f] for f in self.shared]
        self.layout = BlockLayout(fields)
        self._bcs = list(bcs)
        self._prescribed = [prescribed_dofs(f, bcs) for f in self._shared]
        self.x, self.b = self.layout.create_vector(), self.layout.create_vector()
        self._rest = Rest(rest, work, self._shared, self._bcs)
        self.data = cell_data(rest, work)
        self._r = [zeros(f.function_space) for f in self._shared]
        self._arrays = [np.zeros_like(f.x.array) for f in fields]
        for k, vector in zip(self.shared, self._r, strict=True):
            self._arrays[k] = vector.array
        self._couplings = Couplings(self._shared, self._prescribed, self._rest)
        self.K = self._couplings.create_matrix()
        self.unknowns = Unknowns(fields, self.layout, self.x)
        self.singular: list[int] = []
        self.stand_in: Callable[[int], bool] | None = None
        self._attempts = 0
        self._right: Floats = np.zeros(0)
        self._squares: Floats = np.zeros((len(fields), len(fields), 2))
        self._g = [np.zeros_like(f.x.array) for f in self._shared]
        self._lift = [np.zeros_like(f.x.array) for f in fields]
        self._lifts = False
        forget_traversals()
        self.A = self.K
        if len(self.shared) < len(fields):
            size = self.x.getSizes()
            self.A = PETSc.Mat().createPython(
                (size, size), context=_Unassembled(), comm=self.x.comm
            )
            self.A.setUp()
        self.solver = PETSc.SNES().create(self.x.comm)
        self.solver.setOptionsPrefix(prefix)

    def destroy(self) -> None:
        """Destroy PETSc's objects. Collective."""
        for thing in (self.solver, self.A, self.K, self.x, self.b, self._rest, self.unknowns):
            thing.destroy()

    @property
    def problem(self) -> EngineProblem:
        """This stands in the place of DOLFINx's problem."""
        return self

    def condensation(self) -> Condensation:
        """This is its own elimination."""
        own: Condensation = weakref.proxy(self)
        return own

    def residual(self, b: PETSc.Vec) -> None:
        """Assemble the scaled residual at the present fields. Collective."""
        self._assemble_forces()
        for vector, prescribed in zip(self._r, self._prescribed, strict=True):
            vector.array[prescribed] = 0.0
        for k, (f, vector) in enumerate(zip(self._shared, self._r, strict=True)):
            dofs = self._prescribed[k]
            wanted = f.x.array.copy()
            self._set_conditions(f, wanted)
            jump = f.x.array[dofs] - wanted[dofs]
            # Rounding of a step that has met the conditions is no jump.
            rounding = np.abs(jump) <= 4 * np.finfo(float).eps * np.abs(f.x.array[dofs])
            vector.array[dofs] = np.where(rounding, 0.0, jump)
        parts = self.layout.split(b.array_w)
        for part, values, scale in zip(parts, self._arrays, self.unknowns.scales, strict=True):
            part[:] = scale * values[: len(part)]

    def unbalanced(self) -> Floats:
        """The derivative of energy less work by the displacement, without conditions. Collective.

        Returns:
            A force [N] for each local degree of freedom, ghosts included.
        """
        self._assemble_forces()
        self._r[0].scatter_forward()
        forces: Floats = self._r[0].array.copy()
        return forces

    def _assemble_forces(self) -> None:
        """Assemble the residual without units and conditions; shared fields on owned dofs."""
        for values in self._arrays:
            values[:] = 0.0
        self._rest.residual([vector.array for vector in self._r])
        for kernel in self.kernels:
            kernel.residual(self._arrays)
        for vector in self._r:
            vector.scatter_reverse(la.InsertMode.add)

    def jacobian(self, b: PETSc.Vec) -> None:
        """Assemble the scaled condensed matrix; b is the residual. Collective."""
        self._attempts = 0
        self.condense(b.array_r, self.projection)
        self.A.stateIncrease()  # PETSc is not to think that a stand-in stays the same

    def update(self) -> Sequence[int]:
        """Nothing: the condensed matrix is assembled with the Jacobian."""
        return self.singular

    def condense(self, right: Floats, projection: int = 0) -> None:
        """Assemble K at the current fields, and eliminate a right-hand side. Collective.

        Args:
            right: This rank's part of the scaled right-hand side.
            projection: See the attribute.
        """
        self._right = right.copy()
        units = np.repeat(self.unknowns.scales, np.diff(self.layout.offsets))
        parts = self.layout.split(right / units)
        self._set_lift(parts)
        here = self.condense_cells(parts, projection)
        if self._lifts:
            self._rest.lift(self._g, [self._lift[f] for f in self.shared])
        self.singular = sorted(set().union(*self.layout.comm.allgather(here)))
        self._couplings.insert(self.K, self.inertia * self._rest.values())
        if (self.unknowns.scales != 1.0).any():
            unit = self.K.createVecLeft()
            sizes = np.diff(self.layout.offsets)[self.shared]
            unit.array_w[:] = np.repeat(self.unknowns.scales[self.shared], sizes)
            self.K.diagonalScale(unit, unit)
            unit.destroy()

    def _set_lift(self, right: Sequence[Floats]) -> None:
        """Take from a right-hand side how far the prescribed dofs are to move. Collective."""
        moves = False
        for f, prescribed, vector in zip(self.shared, self._prescribed, self._r, strict=True):
            own = prescribed[prescribed < len(right[f])]
            vector.array[:] = 0.0
            vector.array[own] = right[f][own]
            vector.scatter_forward()
            self._lift[f][:] = vector.array
            moves |= bool(np.any(right[f][own]))
        self._lifts = self.layout.comm.allreduce(moves, MPI.LOR)

    def condense_cells(self, right: Sequence[Floats], projection: int = 0) -> set[int]:
        """Condense the cells of this rank into the blocks that K is made of.

        Args:
            right: The right-hand side of each field, in its own unit.
            projection: See `condense`.

        Returns:
            Fields whose local block is singular.
        """
        for values in (*self._couplings.blocks, *self._g, self._squares):
            values[:] = 0.0
        singular: set[int] = set()
        unscaled = bool((self.unknowns.scales == 1.0).all())  # as when scales are looked for
        for kernel in self.kernels:
            own = [self.shared.index(f) for f in kernel.shared]
            at = [i * len(self.shared) + j for i in own for j in own]
            singular |= set(
                kernel.matrix(
                    right,
                    [self._couplings.blocks[k] for k in at],
                    [self._couplings.places[k] for k in at],
                    [self._g[i] for i in own],
                    lift=self._lift if self._lifts else None,
                    projection=projection,
                    marks=self.marks,
                    squares=self._squares if unscaled else None,
                )
            )
        return singular

    @property
    def definite(self) -> bool:
        """Whether only a positive definite K will do: there are stand-ins for others."""
        return self.stand_in is not None

    def assemble(self) -> None:
        """Assemble K anew, for the right-hand side of the last time. Collective."""
        self.condense(self._right, self.projection)

    def project(self) -> bool:
        """Put the next stand-in into K; whether there is one. Collective."""
        self._attempts += 1
        if self.stand_in is not None:
            return self.stand_in(self._attempts)
        if self._attempts > 1 or self.projection or len(self.shared) > 1:
            return False
        self.condense(self._right, 1)
        return True

    def forces(self) -> Floats:
        """The largest entry of the last residual of shared fields on each cell. Collective.

        Without units; of the cells of this rank, ghosts included.
        """
        largest: Floats = np.zeros(0)
        for f, vector in zip(self._shared, self._r, strict=True):
            vector.scatter_forward()
            dofmap = f.function_space.dofmap
            values = np.abs(vector.array).reshape(-1, dofmap.bs).max(axis=1, initial=0.0)
            found: Floats = values[dofmap.list].max(axis=1, initial=0.0)
            largest = np.maximum(largest, found) if largest.size else found
        return largest

    def eliminate(self, right: Floats, g: Sequence[Floats]) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local dofs of shared fields, all scaled. Collective."""
        if not self.layout.comm.allreduce(np.array_equal(right, self._right), MPI.LAND):
            if len(self.shared) == len(self.fields):
                self._set_lift(self.layout.split(right))  # K may be kept
            if len(self.shared) < len(self.fields) or self._lifts:
                self.condense(right, self.projection)
        for k, f in enumerate(self.shared):
            self._g[k][self._prescribed[k]] = 0.0
            g[k][:] += self.unknowns.scales[f] * self._g[k]

    def recover(self, b: Floats, u: Sequence[Floats], x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x, all scaled; u on local dofs."""
        changes = [np.zeros_like(f.x.array) for f in self.fields]
        parts = self.layout.split(x)
        for f, values, prescribed in zip(self.shared, u, self._prescribed, strict=True):
            # An iterative solver leaves an error, and the residual does not see it there.
            values[prescribed] = self._lift[f][prescribed] / self.unknowns.scales[f]
            own = prescribed[prescribed < len(parts[f])]
            parts[f][own] = values[own]
            changes[f][:] = self.unknowns.scales[f] * values
        for kernel in self.kernels:
            kernel.recover(changes)
        for f, part in enumerate(parts):
            if f not in self.shared:
                part[:] = changes[f][: len(part)] / self.unknowns.scales[f]

    def relax(self) -> bool:
        """Move the cell-local fields to where the energy is stationary in them. Collective.

        Returns:
            Whether this has succeeded in every cell.
        """
        failed = sum(kernel.relax(MOST_RELAXATIONS) for kernel in self.kernels)
        return int(self.layout.comm.allreduce(failed)) == 0

    def hold(self, before: Sequence[Floats]) -> int:
        """Move cell-local fields towards former values where the energy has no value. Collective.

        Args:
            before: Former values of each field.

        Returns:
            In how many cells.
        """
        return int(
            self.layout.comm.allreduce(sum(k.hold(before, MOST_HALVINGS) for k in self.kernels))
        )

    def energy(self) -> float:
        """The energy at the current fields [J]. Collective."""
        local = sum(kernel.energy() for kernel in self.kernels) + self._rest.energy()
        return float(self.layout.comm.allreduce(local))

    def meet_conditions(self) -> None:
        """Put the values of the Dirichlet conditions into the fields.

        Else the first Newton step takes the body along.
        """
        for f in self._shared:
            self._set_conditions(f, f.x.array)

    def _set_conditions(self, f: fem.Function, values: Floats) -> None:
        for bc in self._bcs:
            if f.function_space._cpp_object.contains(bc.function_space):
                bc.set(values)

    def rescale(self, scales: Floats) -> None:
        """Give units to unknowns. The matrix gets them when it is next assembled."""
        self.unknowns.set_scales(scales)

    def block_entries(self) -> Floats:
        """Typical entries of blocks of the Jacobian last condensed, shape (fields, fields).

        Of shared fields those of the condensed matrix.
        """
        squares = self.layout.comm.allreduce(self._squares, op=MPI.SUM)
        entries: Floats = np.sqrt(squares[:, :, 0] / np.maximum(squares[:, :, 1], 1))
        entries = np.maximum(entries, entries.T)
        layout = BlockLayout(self._shared)
        indptr, columns, values = self.K.getValuesCSR()
        rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        fields = np.repeat(np.arange(len(self.shared)), np.diff(layout.offsets))[rows]
        pair = fields * len(self.shared) + layout.fields_of(columns.astype(np.int64))
        n = len(self.shared) ** 2
        sums = [np.bincount(pair, weight, n) for weight in (values**2, (values != 0) * 1.0)]
        squares, counts = self.layout.comm.allreduce(np.array(sums), op=MPI.SUM)
        block = np.sqrt(squares / np.maximum(counts, 1)).reshape([len(self.shared)] * 2)
        entries[np.ix_(self.shared, self.shared)] = block
        return entries
