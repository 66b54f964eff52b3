"""Full steps under a watchdog: the default."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from solvers.newton import Newton
from solvers.options import (
    DOWN,
    FARTHEST,
    LONG,
    LONGEST,
    NOWHERE,
    SMALLEST_PART,
    UPHILL,
    WORTH_A_PART,
)
from solvers.stopping import Reason
from solvers.strategies.continuation import Continuation
from solvers.strategies.descent import ProjectOnDemand
from solvers.strategies.full_steps import ResidualSearch


class Watchdog(ResidualSearch):
    """Full steps; a line search on the residual where they diverge; part by part; down the energy.

    Where residuals lead nowhere, what is out of balance at the start is let in part by part, as
    long as the parts need not be small (`Continuation`). Then it goes down the energy. After a step
    that took long the next does without the search.

    The energy of positions, its cell-local fields where it is stationary in them, is a merit that
    any system with an energy has. On it this takes steps of Newton's method from where the parts
    have led: with the exact tangent, projected on demand. Now and then a few full steps may go
    uphill; they count if they end lower.
    """

    def attach(self, newton: Newton) -> None:
        """Look whether there is an energy to go down on."""
        self._down, self._impatient = None, False
        self._parts = Continuation()
        self._parts.attach(newton)
        if newton.system.descends:
            self._down = _Down()
            self._down.attach(newton)
        super().attach(newton)

    def solve(self) -> bool:
        """Iterate. Collective."""
        if super().solve():
            return True
        if not self._may_search or self.newton.exhausted:
            return False
        if self._part_by_part():
            return True
        if self._down is None or self.newton.exhausted:
            return False
        self.newton.note("parts get small: down the energy")
        self.newton.meet_conditions(self.newton.system.x)
        return self._descend(self._down)

    def _part_by_part(self) -> bool:
        self.newton.restart("residuals lead nowhere: from the start again, part by part")
        return self._parts.let_in(SMALLEST_PART if self._down is None else WORTH_A_PART)

    def _search(self) -> bool:
        if self.newton.before > LONG:  # in vain then, and most likely now
            return False
        self._norms: list[float] = []
        self._impatient = self._down is not None
        try:
            return super()._search()
        finally:
            self._impatient = False

    def _descend(self, down: _Down) -> bool:
        newton, x = self.newton, self.newton.system.x
        if not np.isfinite(newton.merit(x)):
            newton.blame("no values near by of the cell-local fields make the energy stationary")
            return False
        lowest, done = x.array_r.copy(), -1
        while not newton.exhausted and newton.iterations > done:
            done = newton.iterations
            x.array_w[:] = lowest
            newton.steer(down)
            try:
                converged = down.descend(DOWN)
            finally:
                down.release()
                newton.steer(self)
            lowest[:] = x.array_r
            if converged or newton.halted:
                return converged
            newton.note("full steps, uphill too")
            if newton.iterate(most=UPHILL):
                return True
            if newton.merit(x) < down.energy:
                lowest[:] = x.array_r
        return False

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """End a search that gets nowhere."""
        if self._impatient:
            self._norms.append(snes.getFunctionNorm())
            before, last = self._norms[1:-NOWHERE], self._norms[-NOWHERE:]
            if before and min(last) > min(before) / 2:
                self.newton.halted = Reason.DIVERGED_LINE_SEARCH


class _Down(ProjectOnDemand):
    """The way down, for cell-local fields too.

    Projected tangents are too stiff, hence long steps. A tangent that is all but singular knows no
    length, hence none that is far too long.
    """

    name, alone, longest, farthest = "watchdog", False, LONGEST, FARTHEST

    def release(self) -> None:
        """Give the tangent back."""
        self.system.stand_in, self.system.projection = None, 0
