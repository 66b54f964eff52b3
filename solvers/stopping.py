"""When a pass of Newton's method ends: PETSc's own rules, rounding error, and divergence."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np

from solvers import options as defaults
from solvers.scaling import Unknowns

Reason = PETSc.SNES.ConvergedReason


class StoppingRule:
    """PETSc's own test, with rounding error as the absolute tolerance; and divergence.

    Attributes:
        floor: Residual norm below which there is only rounding error, in the present solve.
        size: Of the body [m].
        target: Residual norm at which the present pass ends.
        failure: Why it has ended, where the reason alone does not say.
    """

    def __init__(self, snes: PETSc.SNES, unknowns: Unknowns) -> None:
        self._snes, self._unknowns = snes, unknowns
        self.floor = self.size = 0.0
        self.begin([])

    def begin(
        self,
        residuals: Sequence[float],
        growth: float = np.inf,
        *,
        enough: float = 0.0,
        forced: bool = False,
    ) -> None:
        """Begin a pass.

        Args:
            residuals: Their norms in this solve, to which others add.
            growth: Of the residual past that of the first iteration, at which to stop.
            enough: The residual norm that will do.
            forced: Whether to take an iteration where there is no residual at all.
        """
        self._residuals = residuals
        self._growth, self._enough, self._forced = growth, enough, forced
        self._norms: list[float] = []
        self._steps: list[float] = []
        self._stagnates = False
        self.target, self.failure = 0.0, ""

    @property
    def growth(self) -> float:
        """How many times the residual has grown in this pass."""
        return self._norms[-1] / self._norms[0]

    def reason(self, iteration: int, size: float, step: float, norm: float) -> int:
        """Return PETSc's reason to end the pass, or 0. Collective.

        Args:
            iteration: Its number in the pass.
            size: Norm of the unknowns.
            step: Norm of the last step.
            norm: Of the residual.
        """
        rtol, given, stol, _ = self._snes.getTolerances()
        atol = max(given, self.floor * (defaults.NEAR_ROUND_OFF if self._stagnates else 1.0))
        previous = self._norms[-1] if self._norms else norm
        self._norms.append(norm)
        if iteration == 0:
            self.target = max(atol, rtol * norm, self._enough)
        self._stagnates |= iteration > 1 and self._is_rounding_error(norm, previous)
        if not np.isfinite(norm):
            return int(Reason.DIVERGED_FUNCTION_NANORINF)
        if iteration == 0:
            # Rounding error of a stiff part may hide the forces on a soft one, and its motion.
            still = norm == 0.0 and not self._forced
            return int(Reason.CONVERGED_FNORM_ABS if still else Reason.CONVERGED_ITERATING)
        self._steps.append(self._unknowns.largest_move(self._snes.getSolutionUpdate()) / self.size)
        if norm < given or norm < self._enough:
            return int(Reason.CONVERGED_FNORM_ABS)
        if norm < atol and (reason := self._rests()):
            return reason
        if norm <= rtol * (self._residuals[0] if self._residuals else norm):
            return int(Reason.CONVERGED_FNORM_RELATIVE)
        if step < stol * size:
            return int(Reason.CONVERGED_SNORM_RELATIVE)
        limit = self._snes.getDivergenceTolerance()
        if iteration > 1:
            limit = min(limit, self._growth * max(1.0, self._norms[1] / self._norms[0]))
        diverges = norm > limit * self._norms[0]
        return int(Reason.DIVERGED_DTOL if diverges else Reason.CONVERGED_ITERATING)

    def _rests(self) -> int:
        """Whether a body whose forces are rounding error no longer moves either.

        That of a stiff part may hide the forces on a soft one; Newton's steps show them.

        Returns:
            The reason to stop, or 0.
        """
        steps = self._steps
        largest = max(steps[:-1], default=np.inf)
        shrinks = len(steps) < 2 or steps[-1] < steps[-2] / 2
        part = defaults.LAST_STEP if shrinks else defaults.PART_OF_MOTION
        least = 0.0 if shrinks else defaults.TREMBLE
        if steps[-1] <= min(defaults.SETTLED, max(least, part * largest)):
            return int(Reason.CONVERGED_FNORM_ABS)
        if shrinks:
            return 0
        self.failure = (
            "rounding error of the stiffest part hides the forces on others: the numbers do not "
            "fit double precision"
        )
        return int(Reason.DIVERGED_DTOL)

    def _is_rounding_error(self, norm: float, previous: float) -> bool:
        """Whether a small residual no longer falls; the next iteration will then be the last."""
        near = norm <= defaults.NEAR_ROUND_OFF * self.floor
        if self._snes.getLineSearch().getType() != PETSc.SNESLineSearch.Type.BASIC:
            # A line search with tiny steps also stagnates, near its start.
            near = near and norm < defaults.FALLEN * max(self._residuals, default=0.0)
        return near and norm > previous / 2
