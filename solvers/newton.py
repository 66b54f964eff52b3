"""Newton's method on a system: PETSc's SNES, what ends it, and a record of what it did."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

from solvers.domain import Domain, relaxed_on_the_way
from solvers.interruption import Guard
from solvers.lifetime import weakly
from solvers.linear import LINEAR_REASONS, LinearSolver, names_of
from solvers.monitor import Printer
from solvers.result import History
from solvers.scaling import equilibrate
from solvers.stopping import Reason, StoppingRule
from solvers.systems import System

if TYPE_CHECKING:
    from solvers.strategies.base import Strategy

logger = logging.getLogger("mixed_fem")


class Newton:
    """Newton's method, from the fields as they stand.

    Attributes:
        system: What it solves.
        linear: What solves its linear systems.
        history: Of the present solve.
        before: Iterations of the solve before.
        guard: Keeps what callbacks raise; a pass ends by raising that.
        reason: PETSc's reason for the end of the last pass.
        failure: What the linear solver says where that is to blame.
        belongings: What is to be destroyed with the problem.
    """

    def __init__(self, system: System, linear: LinearSolver, guard: Guard) -> None:
        """Put callbacks into the SNES of the system.

        Args:
            system: What to solve.
            linear: What has been made its linear solver.
            guard: Keeps what callbacks raise.
        """
        self.system, self.linear, self.snes = system, linear, system.solver
        self.history, self.before, self._carried = History(), 0, 0
        self.guard = guard
        self.reason, self.failure = 0, ""
        self.belongings: list[Any] = [system]
        self._continued = False
        self._domain = Domain(system, weakly(self.vector), weakly(self.note))
        self._scaled = False
        self._printer = Printer(system)
        self._before = [np.empty_like(f.x.array) for f in system.fields]
        self._rule = StoppingRule(self.snes, system.unknowns)
        self._start: PETSc.Vec | None = None
        self._withheld = 0.0
        self._begin_pass()
        snes, A = self.snes, system.A
        # PETSc must not keep this object alive, which keeps PETSc's objects alive.
        snes.setFunction(guard.callback(self._residual, _no_residual), system.b)
        snes.setJacobian(guard.callback(self._jacobian), A, A)
        snes.setConvergenceTest(guard.callback(self._test, _no_more))
        snes.setMonitor(guard.callback(self._record))

    @property
    def alone(self) -> bool:
        """Whether the displacement is the only field."""
        return len(self.system.fields) == 1

    def steer(self, strategy: Strategy) -> None:
        """Ask a strategy before each iteration and each step."""
        self._exact = strategy.exact
        self.snes.setUpdate(self.guard.callback(strategy.before_iteration))
        self._choose_step = weakly(strategy.before_step)
        self.snes.setLineSearchPreCheck(self.guard.callback(self._before_step))

    def monitor(self, *, newton: bool, krylov: bool) -> None:
        """Print the residual norm of each field at each Newton iteration, at each Krylov one."""
        if newton:
            self.snes.setMonitor(self.guard.callback(self._printer.newton))
        if krylov:
            self.snes.getKSP().setMonitor(self.guard.callback(self._printer.krylov))

    def begin(self) -> None:
        """Begin a solve from the present values of the fields. Collective."""
        for f, values in zip(self.system.fields, self._before, strict=True):
            values[:] = f.x.array
        self.before, self._carried = self._done or self._carried, 0
        self.history, self.failure = History(), ""
        self.guard.begin()
        if not self._scaled:
            self._set_scales()
        self.linear.start()
        self.system.unknowns.read(self.system.x)
        unknowns = self.system.unknowns
        self._rule.floor = unknowns.round_off(self.system.x) if self._exact else 0.0
        self._rule.size, self._rule.failure = unknowns.size(), ""
        self._withheld = 0.0

    def restart(self, note: str) -> None:
        """Begin again where the solve began, and note why. Collective."""
        self.restore()
        self.system.unknowns.read(self.system.x)
        self.linear.restart()
        self.note(note)

    def blame(self, what: str) -> None:
        """Say why the solve failed, before what is known already."""
        self.failure = f"{what}; {self.failure}" if self.failure else what

    def vector(self) -> PETSc.Vec:
        """Return a work vector like the unknowns, destroyed with the problem. Collective."""
        vector = self.system.x.duplicate()
        self.belongings.append(vector)
        return vector

    def note(self, what: str, *, last: bool = False) -> None:
        """Put a remark beside the next iteration, or the last one."""
        notes, k = self.history.notes, len(self.history.residuals) - last
        notes[k] = f"{notes[k]}; {what}" if k in notes else what

    def meet_conditions(self, x: PETSc.Vec) -> None:
        """Put unknowns, and the fields, where the Dirichlet conditions want them. Collective."""
        self.system.unknowns.write(x)
        self.system.meet_conditions()
        self.system.unknowns.read(x)

    def merit(self, x: PETSc.Vec) -> float:
        """The energy of positions [J]. Collective.

        The cell-local fields are where the energy is stationary in them, which makes it a function
        of the others, with the condensed matrix as its second derivative.

        Args:
            x: Scaled unknowns.

        Returns:
            The energy, infinite where there is none.
        """
        followed = True
        with self.evaluation("residual", x):
            if not self.alone:
                followed = self._relaxed()
            energy = self.system.energy() if followed else np.inf
        return energy if np.isfinite(energy) else np.inf

    def _relaxed(self) -> bool:
        """Relax, if need be from values before the solve, or on the way. Collective."""
        if self._domain.left:
            self.system.hold(self._before)
        return self.system.relax() or relaxed_on_the_way(self.system, self._before)

    def restore(self) -> None:
        """Put the values from before the solve into the fields."""
        for f, values in zip(self.system.fields, self._before, strict=True):
            f.x.array[:] = values

    @property
    def size(self) -> float:
        """Of the body [m]."""
        return self._rule.size

    def keep_start(self) -> float:
        """Evaluate the residual where the solve begins, for `withhold`. Collective.

        Returns:
            Its norm.
        """
        if self._start is None:
            self._start = self.vector()
        self._residual(self.snes, self.system.x, self._start)
        return float(self._start.norm())

    def withhold(self, part: float) -> None:
        """Take a part of the residual that `keep_start` has kept away from all residuals to come.

        Args:
            part: From 1, with which the start is a solution, to 0.
        """
        self._withheld = part

    def iterate(
        self,
        growth: float = np.inf,
        *,
        most: int | None = None,
        enough: float = 0.0,
        forced: bool = False,
    ) -> bool:
        """Iterate from where the unknowns are to the end. Collective.

        Args:
            growth: Of the residual past that of the first iteration, at which to stop.
            most: Iterations, no more than what is left of those of the solve.
            enough: The residual norm that will do.
            forced: Whether to take an iteration where there is no residual at all.

        Returns:
            Whether this has converged.
        """
        self._continued, limit = False, self.snes.getTolerances()[3]
        most = limit if most is None else most
        end = min(limit, self._done + most)
        self._pass_to(end, growth=growth, enough=enough, forced=forced)
        while self.reason == Reason.DIVERGED_FUNCTION_NANORINF and self._domain.amend():
            self._continued = True
            self._pass_to(end, growth=growth, enough=enough)
        if self.reason == Reason.DIVERGED_FUNCTION_NANORINF:
            where = self.system.unknowns.not_finite(self.system.b)
            self.failure = f"no finite residual of {where}" if where else ""
            if len(self.history.residuals) <= 1 and where:
                self.failure += ": is a load, a motion or the state it began from no number?"
        elif self.reason == Reason.DIVERGED_DTOL:
            self.failure = self._rule.failure or self._growth_told()
        elif self.reason == Reason.DIVERGED_LINEAR_SOLVE:
            self._count()  # of the iteration that did not come to its end
            reason = self.snes.getKSP().getConvergedReason()
            self.failure = LINEAR_REASONS.get(reason, str(reason))
            if reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
                self.failure += f": {self.linear.why()}"
        if self.reason > 0:
            self.failure = ""
        return self.reason > 0

    def _growth_told(self) -> str:
        """Which field's residual has grown how much in the last pass."""
        last = self.history.norms[-1]
        worst = list(last)[np.argmax(np.multiply([*last.values()], self.system.unknowns.scales))]
        return f"the residual has grown {self._rule.growth:.1e} times, most in {worst}"

    def _pass_to(self, end: int, **rule: Any) -> None:
        """Iterate to some number of iterations of the solve at most."""
        snes, x = self.snes, self.system.x
        self._begin_pass(**rule)
        limit = snes.getTolerances()[3]
        snes.setTolerances(max_it=max(end - self._before_pass, 0))
        try:
            snes.solve(None, x)
        finally:
            snes.setTolerances(max_it=limit)
        self.guard.end()
        self.system.unknowns.write(x)
        self.reason = int(snes.getConvergedReason())

    @property
    def _done(self) -> int:
        """Iterations in the history."""
        return max(len(self.history.residuals) - 1, 0)

    @property
    def exhausted(self) -> bool:
        """Whether no iteration of the solve is left, or more would be lost on rounding error."""
        return bool(self._rule.failure) or self.iterations >= self.snes.getTolerances()[3]

    @property
    def iterations(self) -> int:
        """Newton iterations of the present solve."""
        return self._before_pass + int(self.snes.getIterationNumber())

    def explain(self) -> str:
        """PETSc's name of the reason, and what the linear solver says where that is to blame."""
        name = REASONS[self.reason]
        return f"{name} ({self.failure})" if self.failure else name

    def forget_scales(self) -> None:
        """Find units anew the next time: those of a state that led nowhere may be to blame."""
        self._scaled = False

    def carried(self) -> dict[str, Any]:
        """Numbers that one solve leaves for the next, as plain as JSON."""
        scales = self.system.unknowns.scales.tolist() if self._scaled else None
        rest = {"left": self._domain.left, "iterations": self._done}
        return {"scales": scales, **rest, **self.linear.carried()}

    def carry(self, numbers: Mapping[str, Any]) -> None:
        """Take such numbers for one's own. Collective."""
        self._domain.left, self._carried = numbers["left"], numbers.get("iterations", 0)
        self.linear.carry(numbers)
        if numbers["scales"] is not None:
            self._set_scales(np.array(numbers["scales"]))

    def _begin_pass(self, **rule: Any) -> None:
        self._rule.begin(self.history.residuals, **rule)
        self._domain.begin()
        self._before_pass = self._done + self._continued
        self.halted = 0  # a strategy's reason to end the pass

    def _set_scales(self, scales: npt.NDArray[np.float64] | None = None) -> None:
        """Take these units, or such as suit the present Jacobian. Collective."""
        system = self.system
        system.unknowns.set_scales(np.ones(len(system.fields)))
        system.b.set(0.0)
        system.unknowns.read(system.x)
        self._evaluate_jacobian(system.x)
        system.rescale(equilibrate(system.block_entries()) if scales is None else scales)
        P = self.linear.set_up(system.A)
        self.snes.setJacobian(self.guard.callback(self._jacobian), system.A, P)
        self._scaled = True

    # PETSc's callbacks

    def _before_step(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let the strategy change the step, and keep it where the energy has a value."""
        changed = self._choose_step(x, y)
        return self._domain.watch(x, y) or changed

    def _residual(self, snes: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """The scaled residual at scaled unknowns."""
        with self.evaluation("residual", x):
            self.system.residual(b)
        if self._withheld:
            b.axpy(-self._withheld, self._start)

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        """The scaled Jacobian at scaled unknowns."""
        self._evaluate_jacobian(x)
        self.linear.follow()

    def _evaluate_jacobian(self, x: PETSc.Vec) -> None:
        with self.evaluation("jacobian", x):
            # The residual, which the Newton step is to be solved for, is that of this state.
            self.system.jacobian(self.system.b)

    @contextmanager
    def evaluation(self, phase: str, x: PETSc.Vec) -> Iterator[None]:
        """Put the unknowns into the fields, refresh the per-cell data; take time."""
        start = time.perf_counter()
        self.system.unknowns.write(x)
        for data in self.system.data:
            data.refresh()
        yield
        self.history.timings[phase] += time.perf_counter() - start

    def _test(
        self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]
    ) -> PETSc.SNES.ConvergedReason:
        """The stopping rule; and what others have against going on."""
        if self.guard.watch():
            return Reason.DIVERGED_FUNCTION_COUNT
        reason = self._rule.reason(iteration, *norms)
        if iteration == 0:
            self.linear.target = self._rule.target
        hindered = self.halted and reason != Reason.DIVERGED_FUNCTION_NANORINF
        return self.halted if hindered else reason

    def _record(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        if iteration > 0 or self._continued:
            self._count()
            self._continued = False
        elif self.history.residuals:
            return  # the start again
        self.history.norms.append(self.system.unknowns.norms(self.system.b))
        self.history.residuals.append(float(norm))
        logger.debug("Newton %d: %s", iteration, self.history.norms[-1])

    def _count(self) -> None:
        """Note the linear iterations of the Newton iteration just made."""
        outer, inner = self.linear.count()
        self.history.krylov.append(outer)
        if inner is not None:
            self.history.inner.append(inner)


def _no_residual(snes: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
    """Make PETSc end its iteration."""
    b.set(np.inf)


def _no_more(*_: object) -> int:
    return int(Reason.DIVERGED_FUNCTION_COUNT)


REASONS = names_of(Reason)
