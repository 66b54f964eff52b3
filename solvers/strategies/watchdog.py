"""Full steps under a watchdog: the default."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from solvers.newton import Newton, Reason
from solvers.options import DOWN, FARTHEST, LONGEST, NOWHERE, UPHILL
from solvers.strategies.descent import ProjectOnDemand
from solvers.strategies.full_steps import ResidualSearch


class Watchdog(ResidualSearch):
    """Full steps; a line search on the residual where they diverge; else down the energy.

    The energy of positions, its cell-local fields where it is stationary in them, is a merit that
    any system with an energy has. Where residuals lead nowhere, this takes steps of Newton's method
    on that energy from the start: with the exact tangent, projected on demand. Now and then a few
    full steps may go uphill; they count if they end lower.
    """

    def attach(self, newton: Newton) -> None:
        """Look whether there is an energy to go down on."""
        self._down, self._impatient = None, False
        if newton.system.descends:
            self._down = _Down()
            self._down.attach(newton)
        super().attach(newton)

    def solve(self) -> bool:
        """Iterate. Collective."""
        if super().solve():
            return True
        if not self._may_search or self._down is None or self.newton.exhausted:
            return False
        self.newton.restart("residuals lead nowhere: from the start again, down the energy")
        self.newton.meet_conditions(self.newton.system.x)
        return self._descend(self._down)

    def _search(self) -> bool:
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
