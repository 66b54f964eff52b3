"""From an energy to a converged state: UFL derivatives, DOLFINx's NonlinearProblem, PETSc."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from solvers import options as defaults
from solvers.checks import check_conditions, check_forms
from solvers.condensed import CondensedSolver
from solvers.engine.slots import NotPointwise
from solvers.engine.system import EngineProblem
from solvers.fieldsplit import FieldSplitSolver
from solvers.interruption import Guard, deferred
from solvers.layout import require_local
from solvers.lifetime import destroy_with, require_communicators
from solvers.linear import KrylovSolver, LinearSolver
from solvers.newton import Newton
from solvers.options import SOLVERS, Options, OptionSet
from solvers.preconditioners import BY_SIZE, find
from solvers.result import ConvergenceError, SolveResult
from solvers.rigid import free_motions
from solvers.strategies import STRATEGIES, Strategy
from solvers.systems import AssembledSystem, cell_data

logger = logging.getLogger("mixed_fem")

_serial = itertools.count()

System = AssembledSystem | EngineProblem


@dataclass(frozen=True)
class NewtonStep:
    """One Newton step.

    Attributes:
        changes: Of each field, local degrees of freedom, ghosts included.
        result: Of the solve that this was; its residuals are those before and after.
    """

    changes: tuple[npt.NDArray[np.float64], ...]
    result: SolveResult


class MixedProblem:
    """Make an energy of a displacement and cell-local fields stationary.

    Residual and Newton blocks are UFL derivatives of the energy. Unknowns and equations of each
    field are scaled so that the blocks of the first Jacobian have comparable entries; a multiplier
    comes out scaled by a stress. Per-cell data in the energy (`forms.CellData`) are refreshed at
    each evaluation.

    Attributes:
        fields: The unknowns.
        system: The Newton system, see `solvers.systems.System`.
        condensed: The condensed system with `solver="condensed"`, else None.
        fieldsplit: The block preconditioner with `solver="fieldsplit"`, else None.
    """

    def __init__(
        self,
        energy: ufl.Form,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC] = (),
        *,
        work: ufl.Form | None = None,
        solver: str = "condensed",
        preconditioner: str | None = None,
        engine: bool = True,
        globalisation: str | Strategy | None = None,
        prefix: str | None = None,
        options: Options | None = None,
    ) -> None:
        """Derive and compile the Newton system (seconds the first time, then cached on disk).

        Args:
            energy: Energy [J], a functional of `fields`.
            fields: The unknowns, the displacement first.
            bcs: Dirichlet conditions on the displacement.
            work: Work [J] of forces that have no potential, linear in a test function of the
                displacement: the derivative of the energy is to equal it. The Newton matrix is then
                not symmetric in general, so that LU and GMRES take the place of LDLᵀ and CG.
            solver: A name in `SOLVERS`.
            preconditioner: For `solver="fieldsplit"`: a name in `PRECONDITIONERS`, or "schur-full",
                the default, for a choice by size.
            engine: Whether `solver="condensed"` evaluates the energy point by point in compiled
                code where it can, or always reads the local blocks off the assembled Newton system:
                the same numbers by another route, many times slower.
            globalisation: What keeps Newton's method from diverging: a name in `STRATEGIES`, by
                default "watchdog", or an object, which serves one problem.
            prefix: What the PETSc options of this problem begin with, on the command line too, such
                as "bar_" for `-bar_snes_monitor`. By default one that no other problem has.
            options: PETSc options that override the defaults of Newton's method and of `solver`,
                and are overridden by the command line under the prefix. Those that nothing has used
                after the first solve are logged as a warning. Besides PETSc's there are
                `monitor_newton` and `monitor_krylov`, which print the residual norm of each field
                at each Newton or Krylov iteration.

        Raises:
            ValueError: An unknown solver; an energy that is not a functional of the fields or does
                not go with `forms.measure`; a work that is not linear in a test function of the
                displacement; a condition on what is no field; a prefix that another problem has; or
                choices that do not go together.
            RuntimeError: MPI has too few communicators left, as too many problems are alive.
        """
        if solver not in SOLVERS:
            raise ValueError(f"solver is {solver!r}; available: {', '.join(SOLVERS)}")
        if preconditioner is not None and solver != "fieldsplit":
            raise ValueError(f'solver is {solver!r}; a preconditioner goes with "fieldsplit" only')
        dofmap = fields[0].function_space.dofmap
        unknowns = int(dofmap.index_map.size_global * dofmap.index_map_bs)
        chosen = find(preconditioner or BY_SIZE, unknowns)
        if work is not None and not chosen.unsymmetric and solver == "fieldsplit":
            raise ValueError(f"preconditioner {preconditioner!r} needs a problem without work")
        strategy = globalisation or next(iter(STRATEGIES))
        if isinstance(strategy, str):
            if strategy not in STRATEGIES:
                raise ValueError(
                    f"globalisation is {strategy!r}; available: {', '.join(STRATEGIES)}"
                )
            strategy = STRATEGIES[strategy]()
        check_forms(energy, work, fields, eliminated=solver != "direct")
        check_conditions(bcs, fields)
        require_communicators(fields[0].function_space.mesh.comm)
        self.fields, self._bcs = tuple(fields), tuple(bcs)
        self._cell_data = cell_data(energy, work)
        self._options = OptionSet(prefix or f"mixed_fem_{next(_serial)}_", options or {})
        self.system = _system(
            energy, work, self.fields, bcs, self._options.prefix, solver, engine=engine
        )
        engine = isinstance(self.system, EngineProblem)
        self._strategy = strategy
        self._options.put(strategy.options)
        guard = Guard(fields[0].function_space.mesh.comm)
        snes = self.system.solver
        self.condensed: CondensedSolver | None = None
        self.fieldsplit: FieldSplitSolver | None = None
        linear: LinearSolver
        if solver == "condensed":
            if not engine:
                require_local(self.fields)
            self._options.put(
                defaults.condensed(
                    unknowns, fields[0].function_space.mesh.geometry.dim, symmetric=work is None
                )
            )
            linear = self.condensed = CondensedSolver(self.system, guard)
        elif solver == "fieldsplit":
            linear = self.fieldsplit = FieldSplitSolver(
                self.fields,
                self.system.unknowns.layout,
                snes.getKSP(),
                chosen if work is None else chosen.for_unsymmetric(),
                self._options.put,
            )
        else:
            self._options.put(defaults.DIRECT)
            linear = KrylovSolver(snes.getKSP(), self.system.unknowns.layout.comm)
        snes.setFromOptions()
        self._newton = Newton(self.system, linear, guard)
        self._newton.monitor(
            newton=self._options.flag("monitor_newton"), krylov=self._options.flag("monitor_krylov")
        )
        strategy.attach(self._newton)
        self._refuse_products()
        destroy_with(self, self.system.unknowns.layout.comm, self._newton.belongings)

    @property
    def problem(self) -> Any:
        """DOLFINx's `NonlinearProblem`, or the engine's `EngineProblem` in its place.

        Its SNES is `problem.solver`; its `x` holds the unknowns of the last solve.
        """
        return self.system.problem

    @property
    def scales(self) -> npt.NDArray[np.float64]:
        """Unit of each field in the scaled system, found at the first solve."""
        return self.system.unknowns.scales

    def solve(self) -> SolveResult:
        """Solve from the current values of the fields, and put the solution there.

        By default Newton's method takes full steps. If they diverge, it starts again with a line
        search on the residual, and if that fails too goes down the energy; the result notes it.
        See `solvers.strategies` for this and others.

        Ctrl-C and other signals wait until an iteration has come to its end; then what their
        handlers raise goes out of here.

        Raises:
            ConvergenceError: Newton's method or the linear solver failed. As with any other
                exception the fields keep the values they had, and one may solve again.
        """
        with deferred():
            return self._solve()

    def _solve(self) -> SolveResult:
        start = time.perf_counter()
        try:
            self._newton.begin()
            converged = self._strategy.solve()
        except BaseException:
            self._newton.restore()
            self._newton.forget_scales()
            raise
        self._keep_unknowns()
        if not converged:
            self._newton.restore()
            if free := free_motions(self._newton, self._bcs):
                self._newton.blame(f"next to nothing keeps the body from {free}")
            self._newton.restore()  # scaling rounds
            self._newton.forget_scales()
            raise ConvergenceError(self._finish(start))
        if unstable := self._newton.linear.unstable:
            self._newton.note(f"converged to an unstable state: {unstable}", last=True)
        return self._finish(start, unstable)

    def newton_step(self, *, apply: bool = False) -> NewtonStep:
        """Take one full Newton step from the current values of the fields, even from a solution.

        Args:
            apply: Whether to leave the fields where the step has taken them.

        Returns:
            The step, and what a solve that ends there has to say.

        Raises:
            ConvergenceError: The linear solver failed. The fields keep the values they had.
        """
        start = time.perf_counter()
        before = [f.x.array.copy() for f in self.fields]
        search = self.system.solver.getLineSearch()
        kind, free = search.getType(), Strategy()  # which PETSc does not keep alive
        with deferred():
            self._newton.steer(free)
            search.setType("basic")
            try:
                self._newton.begin()
                done = self._newton.iterate(most=1, forced=True) or self._newton.iterations == 1
            except BaseException:
                self._newton.restore()
                raise
            finally:
                search.setType(kind)
                self._newton.steer(self._strategy)
        self._keep_unknowns()
        result = self._finish(start)
        changes = [f.x.array - v for f, v in zip(self.fields, before, strict=True)]
        if not (done and apply):
            self._newton.restore()
        if not done:
            raise ConvergenceError(result)
        return NewtonStep(tuple(changes), result)

    def carried(self) -> dict[str, Any]:
        """Return what a solve leaves for the next beside the fields, as plain as JSON. Collective.

        Factors and preconditioners are forgotten, so that with these numbers and the fields another
        problem of the same energy goes on as this one does: on one rank with `solver="condensed"`
        to the last bit, else to the tolerances of its solvers.
        """
        self._newton.linear.renew()
        return self._newton.carried()

    def carry(self, numbers: Mapping[str, Any]) -> None:
        """Take what `carried` has returned, before the first solve. Collective."""
        self._newton.carry(numbers)

    def unbalanced_forces(self) -> npt.NDArray[np.float64]:
        """Return the derivative of energy less work by the displacement [N]. Collective.

        In a solution it vanishes but where a Dirichlet condition holds the body: there it is the
        force that the condition exerts, times θ with a scheme that takes Ψ at θ in the step.

        Returns:
            A number for each local degree of freedom of the displacement, ghosts included.
        """
        return self.system.unbalanced()

    def refresh(self) -> None:
        """Recompute all per-cell data from the current fields, for evaluating an expression."""
        for data in self._cell_data:
            data.refresh()

    def _refuse_products(self) -> None:
        """Refuse options for which PETSc would multiply by what the engine does not assemble."""
        if not isinstance(self.system, EngineProblem) or len(self.fields) == 1:
            return
        search, krylov = (
            of.getType() for of in (self.system.solver.getLineSearch(), self.system.solver.getKSP())
        )
        why = "multiplies by the block Jacobian, which the engine does not assemble"
        if search == "bt":
            raise ValueError(f'the line search "bt" {why}; choose "l2" or "cp", or engine=False')
        if krylov not in ("preonly", "none"):
            raise ValueError(
                f"ksp_type is {krylov!r}, which {why}; name the condensed system's, "
                "condensed_ksp_type, or choose engine=False"
            )

    def _keep_unknowns(self) -> None:
        """Leave the unknowns of the last solve in `problem.x`, without units."""
        self.system.unknowns.unscaled.copy(self.system.x)

    def _finish(self, start: float, unstable: str = "") -> SolveResult:
        newton = self._newton
        history, linear = newton.history, newton.linear
        history.timings["total"] = time.perf_counter() - start
        history.timings |= linear.seconds
        if "solve" not in history.timings:
            total = history.timings["total"]
            history.timings["solve"] = 2 * total - sum(history.timings.values())
        self._options.warn_of_unread(self.system.unknowns.layout.comm)
        return SolveResult(
            iterations=newton.iterations,
            krylov=history.krylov,
            inner=history.inner,
            reason=newton.explain(),
            norms=history.norms,
            residuals=history.residuals,
            timings=history.timings,
            notes=linear.notes | history.notes,
            unstable=unstable,
        )


def _system(
    energy: ufl.Form,
    work: ufl.Form | None,
    fields: Sequence[fem.Function],
    bcs: Sequence[fem.DirichletBC],
    prefix: str,
    solver: str,
    *,
    engine: bool,
) -> System:
    """The engine's system where it is wanted and fits the energy, else the assembled one."""
    if solver == "condensed" and engine:
        try:
            return EngineProblem(energy, fields, bcs, prefix, work=work)
        except NotPointwise as why:
            if fields[0].function_space.mesh.comm.rank == 0:
                logger.info("no energy for the engine: %s; assembling it with UFL", why)
    return AssembledSystem(energy, fields, bcs, prefix, work=work, nested=solver != "direct")
