"""From an energy to a converged state: UFL derivatives, DOLFINx's NonlinearProblem, PETSc."""

from __future__ import annotations

import itertools
import logging
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial, singledispatchmethod
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import NonlinearProblem, assign
from ufl.algorithms import expand_derivatives
from ufl.corealg.dag_traverser import DAGTraverser

from forms import CellData, require_measure
from solvers import options as defaults
from solvers.compiled import CellKernel, CompiledProblem, KernelBlocks, weakly
from solvers.condensation import (
    CellBlocks,
    CondensedBlocks,
    CondensedSolver,
    NothingToEliminate,
    forget_factors,
)
from solvers.fieldsplit import FieldSplitSolver
from solvers.layout import BlockLayout
from solvers.lifetime import destroy_dead, destroy_with
from solvers.options import ENERGY_RESOLVED, SOLVERS, Options
from solvers.preconditioners import BY_SIZE, find
from solvers.result import ConvergenceError, SolveResult

logger = logging.getLogger("mixed_fem")

_serial = itertools.count()


class MixedProblem:
    """Make an energy of a displacement and cell-local fields stationary.

    Residual and Newton blocks are UFL derivatives of the energy. Unknowns and equations of each
    field are scaled so that the blocks of the first Jacobian have comparable entries; a multiplier
    comes out scaled by a stress. Per-cell data in the energy (`forms.CellData`) are refreshed at
    each evaluation.

    Attributes:
        fields: The unknowns.
        problem: The `dolfinx.fem.petsc.NonlinearProblem`, or with a kernel what stands in its
            place; its SNES is `problem.solver`.
        condensed: The condensed system with `solver="condensed"`, else None.
        fieldsplit: The block preconditioner with `solver="fieldsplit"`, else None.
        scales: Unit of each field in the scaled system, found at the first solve.
    """

    def __init__(
        self,
        energy: ufl.Form,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC] = (),
        *,
        solver: str = "condensed",
        preconditioner: str | None = None,
        kernel: CellKernel | None = None,
        projected: bool = False,
        options: Options | None = None,
        jit_options: dict[str, Any] | None = None,
    ) -> None:
        """Derive and compile the Newton system (seconds the first time, then cached on disk).

        Args:
            energy: Energy [J], a functional of `fields`. With a kernel, the rest of the energy,
                a functional of the displacement.
            fields: The unknowns, the displacement first, then cell-local fields if there are any.
            bcs: Dirichlet conditions on the displacement.
            solver: A name in `SOLVERS`.
            preconditioner: For `solver="fieldsplit"`: a name in `PRECONDITIONERS`, or "schur-full",
                the default, for a choice by size.
            kernel: A compiled kernel (`forms.kernels`) for a part of the energy, which makes up
                the same Newton system faster; for `solver="condensed"` only.
            projected: Newton's method with the kernel's positive semi-definite tangent and Armijo's
                condition on the energy (Teran et al., 2005), for the displacement alone.
            options: PETSc options that override the defaults of Newton's method and of `solver`,
                and are overridden by the command line under the prefix of `problem.solver`. Those
                that nothing has used after the first solve are logged as a warning. Besides PETSc's
                there are `monitor_newton` and `monitor_krylov`, which print the residual norm of
                each field at each Newton or Krylov iteration.
            jit_options: DOLFINx's options for compiling forms.

        Raises:
            ValueError: An unknown solver, an energy that is not a functional of the fields or does
                not go with `forms.measure`, or options that do not go together.
        """
        if solver not in SOLVERS:
            raise ValueError(f"solver is {solver!r}; available: {', '.join(SOLVERS)}")
        if preconditioner is not None and solver != "fieldsplit":
            raise ValueError(f'solver is {solver!r}; a preconditioner goes with "fieldsplit" only')
        dofmap = fields[0].function_space.dofmap
        unknowns = int(dofmap.index_map.size_global * dofmap.index_map_bs)
        chosen = find(preconditioner or BY_SIZE, unknowns)
        if energy.arguments():
            raise ValueError("the energy has test or trial functions; it must be a functional")
        if kernel is not None and solver != "condensed":
            raise ValueError(f'solver is {solver!r}; a kernel goes with "condensed" only')
        if projected and (kernel is None or len(fields) > 1):
            raise ValueError("projected=True needs a kernel, and the displacement alone as field")
        wanted = fields if kernel is None else fields[:1]
        missing = [f.name for f in wanted if f not in energy.coefficients()]
        if missing:
            raise ValueError(f"the energy does not depend on the field {missing[0]}")
        require_measure(energy)
        destroy_dead(fields[0].function_space.mesh.comm)
        self.fields = tuple(fields)
        self.scales: npt.NDArray[np.float64] = np.ones(len(self.fields))
        self._scaled = False
        self._layout = BlockLayout(self.fields)
        self._cell_data = [c for c in energy.coefficients() if isinstance(c, CellData)]
        self._norms: list[dict[str, float]] = []
        self._residuals: list[float] = []
        self._krylov: list[int] = []
        self._inner: list[int] = []
        self._linear_failure = ""
        self._timings: dict[str, float] = {}

        logger.info("compiling the residual and the Jacobian (cached on disk afterwards)")
        start = time.perf_counter()
        self._prefix = prefix = f"mixed_fem_{next(_serial)}_"
        self.problem: NonlinearProblem | CompiledProblem
        if kernel is None:
            self.problem = _nonlinear_problem(
                energy, self.fields, bcs, prefix, jit_options, nested=solver == "fieldsplit"
            )
        else:
            self.problem = CompiledProblem(
                energy, self.fields, bcs, kernel, prefix, projected=projected
            )
        logger.info("compiled in %.1f s", time.perf_counter() - start)

        snes = self.problem.solver
        # Of the command line's and the user's options those still to be read.
        self._unread = {*_options_under(prefix), *(options or {})}
        self._set_options(options or {})
        self._set_options(_default_options(self.fields, solver, projected))
        self.condensed: CondensedSolver | None = None
        if solver == "condensed":
            self.condensed = CondensedSolver(self.fields, prefix, weakly(self._make_blocks))
            pc = snes.getKSP().getPC()
            pc.setType(PETSc.PC.Type.PYTHON)
            pc.setPythonContext(self.condensed)
        self.fieldsplit: FieldSplitSolver | None = None
        if solver == "fieldsplit":
            self.fieldsplit = FieldSplitSolver(
                self.fields, self._layout, snes.getKSP(), chosen, weakly(self._set_options)
            )
        snes.setFromOptions()
        search = snes.getLineSearch().getType()
        if kernel is not None and len(self.fields) > 1 and search == "bt":
            raise ValueError(
                'the line search "bt" multiplies by the block Jacobian, which is not assembled '
                'with a kernel; choose "l2" or "cp", or no kernel'
            )
        self._may_search = len(self.fields) > 1 and search == "basic"
        self._watch = False
        self._split = False
        self._floor = 0.0
        self._growth_limit = snes.getDivergenceTolerance()
        # PETSc must not keep this object alive, which keeps PETSc's objects alive.
        _, (assemble, _args, kwargs) = snes.getFunction()
        self._assemble_residual = partial(assemble, **kwargs)
        snes.setFunction(weakly(self._residual), self.problem.b)
        A, P, (assemble, _args, kwargs) = snes.getJacobian()
        self._assemble_jacobian = partial(assemble, **kwargs)
        snes.setJacobian(weakly(self._jacobian), A, P)
        snes.setMonitor(weakly(self._monitor))
        self._monitor_fields = PETSc.Options(prefix).getBool("monitor_newton", False)
        if PETSc.Options(prefix).getBool("monitor_krylov", False):
            snes.getKSP().setMonitor(weakly(self._krylov_monitor))
        self._energies: list[float] = []
        if projected:
            snes.setObjective(weakly(self._objective))
            snes.setUpdate(weakly(self._choose_search))
        # D: the scale of each unknown; x: the unscaled unknowns, as DOLFINx's callbacks want them.
        self._D = self.problem.x.duplicate()
        self._x = self.problem.x.duplicate()
        destroy_with(self, self._layout.comm, [self._D, self._x, self.problem])
        self._before = [np.empty_like(f.x.array) for f in self.fields]

    def solve(self) -> SolveResult:
        """Solve from the current values of the fields, and put the solution there.

        Mixed Newton takes full steps. If they diverge, it starts again with a line search that
        minimises the residual along each step; the result notes it.

        Raises:
            ConvergenceError: Newton's method or the linear solver failed. The fields keep the
                values they had.
        """
        start = time.perf_counter()
        for f, values in zip(self.fields, self._before, strict=True):
            values[:] = f.x.array
        if isinstance(self.problem, CompiledProblem):
            self.problem.meet_conditions()
        self._norms, self._residuals, self._energies = [], [], []
        self._krylov, self._inner = [], []
        self._linear_failure = ""
        self._timings = {"residual": 0.0, "jacobian": 0.0}
        if not self._scaled:
            self._set_scales()
        if self.condensed is not None:
            self.condensed.start()
        if self.fieldsplit is not None:
            self.fieldsplit.start()
        snes, x = self.problem.solver, self.problem.x
        self._from_fields(x)
        self._floor = self._round_off()
        snes.setTolerances(atol=self._floor)
        iterations, notes = self._newton(x)
        x.pointwiseMult(x, self._D)
        self._to_fields(x)
        self._timings["total"] = time.perf_counter() - start
        if self.condensed is not None:
            notes = self.condensed.notes | notes
            self._timings |= self.condensed.seconds
        else:
            if self.fieldsplit is not None:
                self._timings |= self.fieldsplit.seconds
            self._timings["solve"] = 2 * self._timings["total"] - sum(self._timings.values())
        self._warn_of_unread_options()
        reason = snes.getConvergedReason()
        result = SolveResult(
            iterations=iterations,
            krylov=self._krylov,
            inner=self._inner,
            reason=self._explain(reason),
            norms=self._norms,
            residuals=self._residuals,
            timings=self._timings,
            notes=notes,
        )
        if reason <= 0:
            self._scaled = False
            self._restore()
            raise ConvergenceError(result)
        return result

    def _newton(self, x: PETSc.Vec) -> tuple[int, dict[int, str]]:
        """Take full steps from x; if they diverge, start again with a line search.

        Returns:
            The number of iterations, and what there is to note about one of them.
        """
        snes = self.problem.solver
        if not self._may_search:
            self._iterate(x)
            return snes.getIterationNumber(), {}
        self._watch = True
        self._iterate(x)
        self._watch = False
        snes.setDivergenceTolerance(self._growth_limit)
        iterations = snes.getIterationNumber()
        reason = snes.getConvergedReason()
        if reason > 0 or reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT:
            return iterations, {}
        self._restore()
        if isinstance(self.problem, CompiledProblem):
            self.problem.meet_conditions()
        self._from_fields(x)
        if self.condensed is not None:
            self.condensed.restart()
        search = snes.getLineSearch()
        search.setType("l2")
        self._iterate(x)
        search.setType("basic")
        note = "full steps diverge: from the start again, with a line search"
        return iterations + snes.getIterationNumber(), {iterations + 1: note}

    def _iterate(self, x: PETSc.Vec) -> None:
        snes = self.problem.solver
        snes.solve(None, x)
        if snes.getConvergedReason() != PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            return
        self._count_krylov()  # of the iteration that did not come to its end
        ksp = snes.getKSP()
        linear = ksp.getConvergedReason()
        self._linear_failure = str(_LINEAR_REASONS.get(linear, linear))
        if linear == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
            if self.condensed is not None:
                why = self.condensed.failure
            elif self.fieldsplit is not None:
                why = self.fieldsplit.forget_factors()
            else:
                why = forget_factors(ksp)
            self._linear_failure += f": {why}"

    def _count_krylov(self) -> None:
        """Note the linear iterations of the Newton iteration just made."""
        if self.condensed is not None:
            self._krylov.append(self.condensed.iterations - sum(self._krylov))
        else:
            self._krylov.append(self.problem.solver.getKSP().getIterationNumber())
        if self.fieldsplit is not None:
            self._inner.append(self.fieldsplit.inner - sum(self._inner))

    def refresh(self) -> None:
        """Recompute all per-cell data from the current fields, for evaluating an expression."""
        for data in self._cell_data:
            data.refresh()

    def _make_blocks(self, A: PETSc.Mat) -> CondensedBlocks:
        if isinstance(self.problem, CompiledProblem):
            if len(self.fields) > 1:
                return KernelBlocks(self.problem, self.scales)
            return NothingToEliminate(A, weakly(self._project))
        if len(self.fields) == 1:
            return NothingToEliminate(A)
        return CellBlocks(self._layout, A, self.fields[0].function_space.dofmap.index_map_bs)

    def _project(self) -> bool:
        assert isinstance(self.problem, CompiledProblem)
        return self.problem.project(float(self.scales[0]))

    def _restore(self) -> None:
        """Put the values from before the solve into the fields."""
        for f, values in zip(self.fields, self._before, strict=True):
            f.x.array[:] = values

    def _from_fields(self, x: PETSc.Vec) -> None:
        assign(self.fields, x)
        x.pointwiseDivide(x, self._D)

    def _to_fields(self, x: PETSc.Vec) -> None:
        for part in x.getNestSubVecs() if x.getType() == PETSc.Vec.Type.NEST else [x]:
            part.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        assign(x, self.fields)

    def _residual(self, snes: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """The scaled residual at scaled unknowns."""
        with self._evaluation("residual", x):
            self._assemble_residual(snes, self._x, b)
            b.pointwiseMult(b, self._D)

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        """The scaled Jacobian at scaled unknowns."""
        with self._evaluation("jacobian", x):
            self._assemble_jacobian(snes, self._x, A, P)
            A.diagonalScale(self._D, self._D)
        if self.fieldsplit is not None:
            self.fieldsplit.update()

    def _objective(self, snes: PETSc.SNES, x: PETSc.Vec) -> float:
        """The energy at scaled unknowns, for the line search."""
        assert isinstance(self.problem, CompiledProblem)
        with self._evaluation("residual", x):
            energy = self.problem.energy()
        return energy

    def _choose_search(self, snes: PETSc.SNES, iteration: int) -> None:
        """Take full steps once rounding error hides what a step does to the energy."""
        assert isinstance(self.problem, CompiledProblem)
        self._energies.append(self.problem.energy())
        search = snes.getLineSearch()
        if iteration == 0:
            search.setFromOptions()
        elif abs(np.diff(self._energies[-2:])[0]) < ENERGY_RESOLVED * abs(self._energies[-1]):
            search.setType("basic")

    @contextmanager
    def _evaluation(self, phase: str, x: PETSc.Vec) -> Iterator[None]:
        """Unscale the unknowns, put them into the fields, refresh the per-cell data; take time."""
        start = time.perf_counter()
        self._x.pointwiseMult(x, self._D)
        self._to_fields(self._x)
        self.refresh()
        yield
        self._timings[phase] += time.perf_counter() - start

    def _monitor(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        if iteration > 0:
            self._count_krylov()
        norms = self._field_norms(self.problem.b)
        if self._monitor_fields:
            self._print_norms("Newton", iteration, norms)
        if iteration == 0 and self._norms:
            return  # the start again
        if iteration == 0 and self.condensed is not None:
            rtol, atol, *_ = snes.getTolerances()
            self.condensed.target = max(atol, rtol * norm)
        if iteration == 1 and self._watch:
            growth = max(1.0, norm / self._residuals[0])
            snes.setDivergenceTolerance(min(self._growth_limit, defaults.DIVERGING * growth))
        near = norm <= defaults.NEAR_ROUND_OFF * self._floor
        if snes.getLineSearch().getType() != PETSc.SNESLineSearch.Type.BASIC:
            # One that cuts its steps to nothing stagnates too, where it began.
            near = near and norm < defaults.FALLEN * max(self._residuals, default=0.0)
        if near and iteration > 1 and norm > self._residuals[-1] / 2:
            # Rounding error, as it no longer falls; the next iteration will be the last.
            snes.setTolerances(atol=defaults.NEAR_ROUND_OFF * self._floor)
        self._norms.append(norms)
        self._residuals.append(float(norm))
        logger.debug("Newton %d: %s", iteration, norms)

    def _krylov_monitor(self, ksp: PETSc.KSP, iteration: int, norm: float) -> None:
        self._print_norms("  Krylov", iteration, self._field_norms(ksp.buildResidual()))

    def _field_norms(self, b: PETSc.Vec) -> dict[str, float]:
        """The norm of each field's part of a scaled residual, in the field's own units."""
        # Not np.dot, which wakes the threads of BLAS.
        sums = np.array([np.einsum("i,i", part, part) for part in self._layout.split(b.array_r)])
        norms = np.sqrt(self._layout.comm.allreduce(sums, op=MPI.SUM)) / self.scales
        return {f.name: float(n) for f, n in zip(self.fields, norms, strict=True)}

    def _print_norms(self, method: str, iteration: int, norms: dict[str, float]) -> None:
        if self._layout.comm.rank == 0:
            parts = (f"|r_{name}| {norm:.6e}" for name, norm in norms.items())
            print(f"{method} {iteration:3d}", *parts, sep="  ", flush=True)

    def _set_scales(self) -> None:
        """Equilibrate the blocks of the Jacobian at the current state (Ruiz, RAL-TR-2001-034)."""
        n, snes, A = len(self.fields), self.problem.solver, self.problem.A
        self._D.set(1.0)
        assign(self.fields, self.problem.x)
        self._jacobian(snes, self.problem.x, A, A)
        entries = (
            self.problem.block_entries()
            if isinstance(self.problem, CompiledProblem)
            else self._block_entries(A)
        )
        # The cell-local fields among themselves first: a multiplier takes the unit of the Hessian
        # that it stands beside, whatever inertia adds to the displacement's own block.
        scales = np.ones(n)
        local = np.s_[1:]
        for _ in range(50 if n > 1 else 0):
            block = scales[local, None] * entries[local, local] * scales[local]
            largest = block.max(axis=1)
            scales[local] /= np.sqrt(np.where(largest > 0.0, largest, 1.0))
        with np.errstate(divide="ignore"):
            scales[0] = 1.0 / max(np.sqrt(entries[0, 0]), *(entries[0, local] * scales[local]), 0.0)
        # A state without a Jacobian is for Newton's method to report, or all of u is given.
        self.scales[:] = scales if np.isfinite(scales).all() else 1.0
        self._scaled = True
        self._D.array_w[:] = np.repeat(self.scales, np.diff(self._layout.offsets))
        if self.fieldsplit is not None and not self._split:
            A.diagonalScale(self._D, self._D)
            snes.setJacobian(weakly(self._jacobian), A, self.fieldsplit.set_up(A))
            self._split = True

    def _block_entries(self, A: PETSc.Mat) -> npt.NDArray[np.float64]:
        """Root mean square of the entries of each block, shape (fields, fields)."""
        n = len(self.fields)
        if A.getType() == PETSc.Mat.Type.NEST:
            return self._nested_block_entries(A)
        indptr, columns, values = A.getValuesCSR()
        column_field = self._layout.fields_of(columns)
        row_field = np.repeat(np.arange(n), np.diff(self._layout.offsets))
        in_row = np.diff(indptr)
        # The identity rows of Dirichlet conditions, which are on the displacement, carry no unit.
        carries = (row_field > 0) | (np.add.reduceat(values != 0, indptr[:-1]) > 1)
        weight = np.repeat(carries, in_row) & (values != 0)
        pair = np.repeat(row_field, in_row) * n + column_field
        sums = np.array(
            [np.bincount(pair, w, n * n) for w in (weight * values**2, weight.astype(float))]
        )
        squares, counts = self._layout.comm.allreduce(sums, op=MPI.SUM)
        return np.sqrt(squares / np.maximum(counts, 1)).reshape(n, n)

    def _nested_block_entries(self, A: PETSc.Mat) -> npt.NDArray[np.float64]:
        n = len(self.fields)
        sums = np.zeros((2, n, n))
        for f, g in np.ndindex(n, n):
            if block := A.getNestSubMatrix(f, g):
                indptr, _, values = block.getValuesCSR()
                if f == g == 0:
                    in_row = np.diff(indptr)
                    free = np.add.reduceat(values != 0, indptr[:-1]) > 1
                    values = values[np.repeat(free, in_row)]
                sums[:, f, g] = np.sum(values**2), np.count_nonzero(values)
        squares, counts = self._layout.comm.allreduce(sums, op=MPI.SUM)
        entries: npt.NDArray[np.float64] = np.sqrt(squares / np.maximum(counts, 1))
        return entries

    def _set_options(self, options: Options) -> None:
        """Enter options for as long as this object lives, where there are none yet."""
        database = PETSc.Options(self._prefix)
        present = _options_under(self._prefix)
        ours = {key: value for key, value in options.items() if key not in present}
        for key, value in ours.items():
            database[key] = value

        def remove() -> None:
            for key in ours:
                database.delValue(key)

        weakref.finalize(self, remove)

    def _warn_of_unread_options(self) -> None:
        """Report the user's options that nothing has asked for, once."""
        used = PETSc.Options().used
        unread = [self._prefix + key for key in self._unread if not used(self._prefix + key)]
        self._unread.clear()
        if unread and self._layout.comm.rank == 0:
            logger.warning("options that nothing has used: %s", ", ".join(sorted(unread)))

    def _explain(self, reason: int) -> str:
        """PETSc's name of the reason, and what the linear solver says where that is to blame."""
        if reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            return f"{_REASONS[reason]} ({self._linear_failure})"
        return _REASONS[reason]

    def _round_off(self) -> float:
        """The scaled residual below which there is only rounding error.

        Entries of the scaled Jacobian are of order one, so that a perturbation of the unknowns by
        machine precision changes the scaled residual by machine precision times their norm. The
        displacement counts with the size of the body, whose positions are what rounding acts on.
        """
        X = self.fields[0].function_space.mesh.geometry.x
        corners = np.concatenate([X.max(axis=0, initial=-np.inf), -X.min(axis=0, initial=np.inf)])
        self._layout.comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MAX)
        size = float(np.linalg.norm(corners[:3] + corners[3:])) / self.scales[0]
        dofmap = self.fields[0].function_space.dofmap
        norm = np.hypot(self.problem.x.norm(), size * np.sqrt(dofmap.index_map.size_global))
        # A start that is no state is for Newton's method to report.
        return float(np.nan_to_num(np.finfo(float).eps * norm))


def _nonlinear_problem(
    energy: ufl.Form,
    fields: Sequence[fem.Function],
    bcs: Sequence[fem.DirichletBC],
    prefix: str,
    jit_options: dict[str, Any] | None,
    *,
    nested: bool,
) -> NonlinearProblem:
    """The Newton system of an energy: its first and second UFL derivatives by block."""
    tests = [ufl.TestFunction(f.function_space) for f in fields]
    trials = [ufl.TrialFunction(f.function_space) for f in fields]
    residual = [ufl.derivative(energy, f, v) for f, v in zip(fields, tests, strict=True)]
    jacobian: Any = [  # DOLFINx takes None for a block that vanishes; its type does not say so
        [_or_none(ufl.derivative(r, f, du)) for f, du in zip(fields, trials, strict=True)]
        for r in residual
    ]
    if jacobian[0][0] is None:
        # The rows of Dirichlet conditions need a block to stand in.
        zero = fem.Constant(fields[0].function_space.mesh, 0.0)
        jacobian[0][0] = zero * ufl.inner(trials[0], tests[0]) * ufl.dx
    problem = NonlinearProblem(
        residual,
        fields,
        J=jacobian,
        bcs=list(bcs),
        kind="nest" if nested and len(fields) > 1 else "mpi",
        petsc_options_prefix=prefix,
        jit_options=jit_options,
    )
    _forget_traversals()
    return problem


def _forget_traversals() -> None:
    """Free what UFL's algorithms keep alive: forms, and so meshes and their communicators.

    They are single-dispatch methods, whose cache in Python 3.13 holds each object that called them.
    MPICH has 2048 communicators; a study would run out of them.
    """
    kinds = [DAGTraverser]
    for kind in kinds:
        kinds += kind.__subclasses__()
        for attribute in vars(kind).values():
            if isinstance(attribute, singledispatchmethod):
                getattr(attribute, "_method_cache", {}).clear()


def _options_under(prefix: str) -> set[str]:
    """Names of the options there are under a prefix, without it."""
    # PETSc counts an option that it is asked for as used; this way it is not asked.
    return {key.removeprefix(prefix) for key in PETSc.Options().getAll() if key.startswith(prefix)}


def _default_options(fields: Sequence[fem.Function], solver: str, projected: bool) -> Options:
    newton = defaults.NEWTON if len(fields) > 1 else defaults.BACKTRACKING
    if projected:
        newton = defaults.PROJECTED
    if solver == "direct":
        return {**newton, **defaults.DIRECT}
    if solver == "fieldsplit":
        return newton
    dofmap = fields[0].function_space.dofmap
    small = dofmap.index_map.size_global * dofmap.index_map_bs <= defaults.DIRECT_UP_TO
    condensed = defaults.CONDENSED_DIRECT if small else defaults.CONDENSED_CG
    prefixed = {f"condensed_{key}": value for key, value in condensed.items()}
    return {**newton, **defaults.CONDENSED, **prefixed}


def _or_none(form: ufl.Form) -> ufl.Form | None:
    """A block that vanishes identically as None."""
    form = expand_derivatives(form)
    return None if form.empty() else form


def _names(reasons: type) -> dict[int, str]:
    """PETSc's names of its reasons for stopping."""
    return {
        value: name
        for name, value in vars(reasons).items()
        if isinstance(value, int) and name.startswith(("CONVERGED", "DIVERGED"))
    }


_REASONS = _names(PETSc.SNES.ConvergedReason)
_LINEAR_REASONS = _names(PETSc.KSP.ConvergedReason)
