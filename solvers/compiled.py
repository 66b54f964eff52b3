"""The Newton system of an energy whose larger part a compiled per-cell kernel supplies."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from dolfinx.fem.petsc import assemble_matrix, create_vector

from solvers.layout import BlockLayout

_assemble_matrix: Any = assemble_matrix  # its overloads are not typed

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


class CellKernel(Protocol):
    """What a compiled kernel offers: a part of the energy and of its Newton system.

    All arrays hold local degrees of freedom, ghosts included, as `Function.x.array` does.
    """

    @property
    def residual(self) -> Callable[..., None]:
        """Adds the derivatives of the energy to an array for each field."""

    @property
    def couplings(self) -> Ints:
        """Pairs of blocks of displacement dofs that share one of this rank's cells.

        Local numbers, shape (pairs, 2).
        """

    def matrix(self, K: Floats, *, projected: bool = False) -> None:
        """Add this rank's cells to the blocks of the condensed matrix, shape (pairs, d, d)."""

    def energy(self) -> float:
        """Return the energy of this rank's cells without its multiplier's term [J]."""


class EliminatingKernel(CellKernel, Protocol):
    """A kernel with two cell-local fields, of which D = (H, -w; -w, 0) with w diagonal."""

    def eliminate(self, b_S: Floats, b_Y: Floats, b_u: Floats) -> None:
        """Add -Bᵀ D⁻¹ b_l to b_u."""

    def recover(self, du: Floats, b_S: Floats, b_Y: Floats, dS: Floats, dY: Floats) -> None:
        """Set δl = D⁻¹ (b_l - B δu) on owned cells."""


class CompiledProblem:
    """The callbacks and vectors of a `dolfinx.fem.petsc.NonlinearProblem`, made with a kernel.

    Attributes:
        fields: The unknowns.
        kernel: The kernel.
        layout: Their numbering.
        solver: The SNES.
        x: Unknowns, in DOLFINx's blocked layout.
        b: Residual.
        A: The Jacobian: the condensed matrix itself without cell-local fields, else a shell that
            stands for the block system and is only ever solved with.
        K: The condensed matrix.
        prescribed: Local displacement dofs, ghosts included, with Dirichlet conditions.
    """

    def __init__(
        self,
        energy: ufl.Form,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC],
        kernel: CellKernel,
        prefix: str,
        *,
        projected: bool = False,
    ) -> None:
        """Compile the part of the energy that is not the kernel's.

        Args:
            energy: The other part of the energy [J], a functional of the displacement alone.
            fields: The unknowns, the displacement first.
            bcs: Dirichlet conditions on the displacement.
            kernel: The kernel's part of the energy.
            prefix: Options prefix of the SNES.
            projected: Whether the Jacobian is always the kernel's positive semi-definite one.
        """
        u = fields[0]
        V = u.function_space
        self.fields, self.kernel = fields, kernel
        self._bcs = list(bcs)
        self.layout = BlockLayout(fields)
        residual = ufl.derivative(energy, u, ufl.TestFunction(V))
        self.prescribed = np.concatenate(
            [bc.dof_indices()[0] for bc in bcs] or [np.zeros(0, dtype=np.int32)]
        )
        self._residual = fem.form(residual)
        self._energy = fem.form(energy)
        self._projected = projected
        self._r_u = la.vector(V.dofmap.index_map, V.dofmap.index_map_bs)
        self._r_l = [np.zeros_like(f.x.array) for f in fields[1:]]
        spaces = [f.function_space for f in fields]
        self.x, self.b = create_vector(spaces, kind="mpi"), create_vector(spaces, kind="mpi")
        self._couplings = _Couplings(V, kernel.couplings, self.prescribed)
        self.K = self._couplings.create_matrix()
        jacobian = fem.form(ufl.derivative(residual, u, ufl.TrialFunction(V)))
        self._rest = _Rest(jacobian, bcs, self.K)
        self.A = self.K
        if len(fields) > 1:
            size = self.x.getSizes()
            self.A = PETSc.Mat().createPython((size, size), context=_Shell(self), comm=self.x.comm)
            self.A.setUp()
        self.solver = PETSc.SNES().create(self.x.comm)
        self.solver.setOptionsPrefix(prefix)
        self.solver.setFunction(self._assemble_residual, self.b)
        self.solver.setJacobian(self._assemble_jacobian, self.A)

    def destroy(self) -> None:
        """Destroy PETSc's objects. Collective."""
        for thing in (self.solver, self.A, self.K, self.x, self.b, self._rest):
            thing.destroy()

    def _assemble_residual(self, snes: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
        r_u = self._r_u.array
        for values in (r_u, *self._r_l):
            values[:] = 0.0
        fem.assemble_vector(r_u, self._residual)
        self.kernel.residual(r_u, *self._r_l)
        self._r_u.scatter_reverse(la.InsertMode.add)
        # The fields meet the conditions (`MixedProblem` sees to it), so that nothing is lifted.
        r_u[self.prescribed] = 0.0
        for part, values in zip(self.layout.split(b.array_w), (r_u, *self._r_l), strict=True):
            part[:] = values[: len(part)]

    def _assemble_jacobian(
        self, snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat
    ) -> None:
        self.assemble_condensed(projected=self._projected)

    def assemble_condensed(self, *, projected: bool) -> None:
        """Assemble K at the current fields, in their own units. Collective.

        Args:
            projected: Whether to make the kernel's part positive semi-definite cell by cell.
        """
        blocks = self._couplings.blocks
        blocks[:] = 0.0
        self.kernel.matrix(blocks, projected=projected)
        self._couplings.insert(self.K)
        self.K.axpy(1.0, self._rest.matrix(), PETSc.Mat.Structure.SAME_NONZERO_PATTERN)

    def project(self, scale: float) -> bool:
        """Assemble K positive semi-definite, for a displacement in this unit. Collective."""
        self.assemble_condensed(projected=True)
        self.K.scale(scale**2)
        return True

    def energy(self) -> float:
        """The energy at the current fields [J]. Collective."""
        local = self.kernel.energy() + fem.assemble_scalar(self._energy)
        return float(self.layout.comm.allreduce(local))

    def meet_conditions(self) -> None:
        """Put the values of the Dirichlet conditions into the displacement."""
        for bc in self._bcs:
            bc.set(self.fields[0].x.array)

    def block_entries(self) -> Floats:
        """Typical entries of the block Jacobian last assembled, shape (fields, fields).

        The condensed matrix stands for the displacement's own block. The local blocks are read off
        their inverse: of (H, -w; -w, 0) it is (0, -1/w; -1/w, -H/w²).
        """
        kernel = cast(EliminatingKernel, self.kernel)
        n = len(self.fields)
        entries = np.zeros((n, n))
        nonzeros = self.K.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
        entries[0, 0] = self.K.norm() / np.sqrt(nonzeros)
        if n > 1:
            zero, one = np.zeros_like(self.fields[1].x.array), np.ones_like(self.fields[1].x.array)
            dS, dY = np.zeros_like(one), np.zeros_like(one)
            kernel.recover(np.zeros_like(self.fields[0].x.array), zero, one, dS, dY)
            squares = np.array([np.sum(dS**2), np.sum(dY**2), np.count_nonzero(dS)])
            squares = self.layout.comm.allreduce(squares, op=MPI.SUM)
            in_S, in_Y = np.sqrt(squares[:2] / max(squares[2], 1))
            entries[1, 2] = entries[2, 1] = 1.0 / in_S
            entries[1, 1] = in_Y / in_S**2
        return entries


def weakly[**P, T](method: Callable[P, T]) -> Callable[P, T]:
    """A function that calls a bound method without keeping its object alive."""
    reference = weakref.WeakMethod(method)

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = reference()
        assert bound is not None
        return bound(*args, **kwargs)

    return call


class _Couplings:
    """The blocks of a matrix on the displacement that this rank's cells contribute to.

    Attributes:
        blocks: Their values, shape (pairs, d, d).
    """

    def __init__(self, V: fem.FunctionSpace, pairs: Ints, prescribed: Ints) -> None:
        """Find the entries in rows and columns of prescribed dofs, which stay zero."""
        self._dofmap, self._pairs = V.dofmap, pairs
        d = V.dofmap.index_map_bs
        self.blocks: Floats = np.zeros((len(pairs), d, d))
        index_map = V.dofmap.index_map
        marked = np.zeros((index_map.size_local + index_map.num_ghosts, d), dtype=bool)
        marked.ravel()[prescribed] = True
        rows, columns = marked[pairs.T]
        self._prescribed = np.flatnonzero(rows[:, :, None] | columns[:, None, :])

    def create_matrix(self) -> PETSc.Mat:
        """Create a matrix for `insert` with the couplings of all ranks as pattern. Collective."""
        index_map, d = self._dofmap.index_map, self._dofmap.index_map_bs
        numbers = index_map.local_to_global(self._pairs.ravel()).reshape(-1, 2)
        first = d * numbers.astype(PETSc.IntType)
        component = np.arange(d, dtype=PETSc.IntType)
        rows = first[:, 0, None, None] + component[:, None]
        columns = first[:, 1, None, None] + component
        K = PETSc.Mat().create(index_map.comm)
        K.setSizes(((index_map.size_local * d, None),) * 2, bsize=d)
        K.setType(PETSc.Mat.Type.AIJ)
        K.setPreallocationCOO(
            *(np.broadcast_to(i, self.blocks.shape).ravel() for i in (rows, columns))
        )
        local = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        to_global = index_map.local_to_global(local).astype(PETSc.IntType)
        lgmap = PETSc.LGMap().create(to_global, bsize=d, comm=K.comm)
        K.setLGMap(lgmap, lgmap)
        lgmap.destroy()
        self.insert(K)  # PETSc duplicates the pattern of assembled matrices only
        return K

    def insert(self, K: PETSc.Mat) -> None:
        """Put the sum over the ranks into K. Collective."""
        values = self.blocks.reshape(-1)
        values[self._prescribed] = 0.0
        K.setValuesCOO(values, PETSc.InsertMode.INSERT)


class _Rest:
    """The Jacobian of an energy, assembled only when what it depends on has changed.

    Inertia is quadratic in the displacement: its Jacobian changes with the time step and the
    density alone.
    """

    def __init__(self, form: fem.Form, bcs: Sequence[fem.DirichletBC], K: PETSc.Mat) -> None:
        """Make a matrix with the pattern of K, which has all couplings within cells."""
        self._form = form
        self._bcs = list(bcs)
        self._matrix = K.duplicate()
        compiled = form._cpp_object
        self._inputs = lambda: [
            *(c.value for c in compiled.constants),
            *(c.x.array for c in compiled.coefficients),
        ]
        self._known: list[Floats] = []

    def destroy(self) -> None:
        """Destroy the matrix. Collective."""
        self._matrix.destroy()

    def matrix(self) -> PETSc.Mat:
        """Return the matrix, with ones on the diagonal for Dirichlet conditions. Collective."""
        inputs = self._inputs()
        same = len(self._known) > 0 and all(map(np.array_equal, inputs, self._known))
        if not self._form.mesh.comm.allreduce(same, op=MPI.LAND):
            self._known = [values.copy() for values in inputs]
            self._matrix.zeroEntries()
            _assemble_matrix(self._matrix, self._form, self._bcs, diag=1.0)
            self._matrix.assemble()
        return self._matrix


class _Shell:
    """The block Jacobian, which is not assembled: scaling reaches the condensed matrix."""

    def __init__(self, problem: CompiledProblem) -> None:
        self._problem = weakref.ref(problem)

    def diagonalScale(self, A: PETSc.Mat, left: PETSc.Vec, right: PETSc.Vec) -> None:
        """Scale K as the displacement's rows and columns are to be."""
        problem = self._problem()
        assert problem is not None
        scale = problem.K.createVecLeft()
        scale.array_w[:] = left.array_r[: scale.getLocalSize()]
        problem.K.diagonalScale(scale, scale)
        scale.destroy()


class KernelBlocks:
    """Elimination by a kernel, in the scaled unknowns of a `MixedProblem`."""

    def __init__(self, problem: CompiledProblem, scales: Floats) -> None:
        """Make buffers.

        Args:
            problem: Holds the condensed matrix and a kernel with two cell-local fields.
            scales: Unit of each field.
        """
        self.K = problem.K
        self._kernel = cast(EliminatingKernel, problem.kernel)
        self._scales = scales
        self._layout, self._prescribed = problem.layout, problem.prescribed
        self._project = weakly(problem.project)
        self._u, self._b_S, self._b_Y, self._dS, self._dY = (
            np.zeros_like(f.x.array) for f in (*problem.fields, *problem.fields[1:])
        )

    def update(self, A: PETSc.Mat) -> Sequence[int]:
        """Nothing: the condensed matrix is assembled with the Jacobian."""
        return ()

    def project(self) -> bool:
        """Make the cells' parts of K positive semi-definite. Collective."""
        return self._project(float(self._scales[0]))

    def eliminate(self, b: Floats, g: Floats) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local displacement dofs, for this rank's unknowns b."""
        self._set_right_hand_side(b)
        self._u[:] = 0.0
        self._kernel.eliminate(self._b_S, self._b_Y, self._u)
        self._u[self._prescribed] = 0.0
        self._u *= self._scales[0]
        g += self._u

    def recover(self, b: Floats, u: Floats, x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x; u on local dofs."""
        self._set_right_hand_side(b)
        np.multiply(u, self._scales[0], out=self._u)
        self._kernel.recover(self._u, self._b_S, self._b_Y, self._dS, self._dY)
        _, x_S, x_Y = self._layout.split(x)
        x_S[:] = self._dS[: len(x_S)] / self._scales[1]
        x_Y[:] = self._dY[: len(x_Y)] / self._scales[2]

    def _set_right_hand_side(self, b: Floats) -> None:
        _, b_S, b_Y = self._layout.split(b)
        self._b_S[: len(b_S)] = b_S / self._scales[1]
        self._b_Y[: len(b_Y)] = b_Y / self._scales[2]
