"""Full steps under a watchdog: the default."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

from solvers.newton import Newton, Reason
from solvers.options import (
    ARMIJO,
    DIVERGING,
    DOWN,
    ENERGY_RESOLVED,
    LONGEST,
    SHORTEST,
    UPHILL,
    WORTHWHILE,
)
from solvers.strategies.full_steps import ResidualSearch


class Watchdog(ResidualSearch):
    """Full steps; a line search on the residual where they diverge; else down the energy.

    The energy of positions, its cell-local fields where it is stationary in them, is a merit that
    any system with an energy has. Where residuals lead nowhere, this begins at the lowest energy
    seen, and lets no step go up: a step of the mixed system if it goes down; else cell-local fields
    are reset to where the energy is stationary in them, for a step of Newton's method on the energy
    itself, with the exact tangent if half of that step is of use, or with one that is positive
    semi-definite at each point: absolute eigenvalues, or clamped ones where those prove too stiff.
    Now and then a few full steps may go uphill; they count if they end lower.
    """

    def attach(self, newton: Newton) -> None:
        """Look whether there is an energy to go down on."""
        super().attach(newton)
        self._phi = np.nan  # at the unknowns, while on the way down
        if newton.system.descends:
            self._base, self._step, self._trial = (newton.vector() for _ in range(3))

    def solve(self) -> bool:
        """Iterate. Collective."""
        self._seen: list[npt.NDArray[np.float64]] = []
        self._phi = np.nan
        self._projection = 2
        if super().solve():
            return True
        newton = self.newton
        if not self._may_search or not newton.system.descends or newton.exhausted:
            return False
        newton.restart("residuals lead nowhere: down the energy, from the lowest seen")
        return self._descend()

    def _descend(self) -> bool:
        newton, x = self.newton, self.newton.system.x
        states, energies = [x.array_r.copy(), *self._seen], []
        self._seen.clear()
        for values in states:
            x.array_w[:] = values
            newton.meet_conditions(x)
            values[:] = x.array_r
            energies.append(newton.merit(x))
        phi = min(energies)
        best = states[energies.index(phi)]
        if not np.isfinite(phi):
            newton.blame("no values near by of the cell-local fields make the energy stationary")
            return False
        done = -1
        while not newton.exhausted and newton.iterations > done:
            done = newton.iterations
            self._phi = self._begin_at(best)
            if newton.iterate(most=DOWN):
                return True
            phi, self._phi = self._phi, np.nan
            best[:] = x.array_r
            if newton.halted:
                return False
            self._begin_at(best)
            newton.note("full steps, uphill too")
            if newton.iterate(growth=DIVERGING, most=UPHILL):
                return True
            if newton.merit(x) < phi:
                best[:] = x.array_r
        return False

    def _begin_at(self, state: npt.NDArray[np.float64]) -> float:
        """Go there, with cell-local fields where the energy is stationary in them; return it."""
        x = self.newton.system.x
        x.array_w[:] = state
        phi = self.newton.merit(x)
        self.newton.system.unknowns.read(x)
        return phi

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Keep the first few states of a pass."""
        system = self.newton.system
        if system.descends and np.isnan(self._phi) and 0 < iteration <= 3:
            self._seen.append(system.x.array_r.copy())

    def before_step(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """On the way down, see that the step goes down."""
        if np.isnan(self._phi):
            return False
        if length := self._length(x, y, WORTHWHILE, 0.0):
            y.scale(length)
            self.newton.note(f"step {length:g}")
            return True
        absolute = self._projection == 2
        name = "absolute" if absolute else "clamped"
        for projection, tangent, shortest in (
            (0, "exact", WORTHWHILE),
            (self._projection, name, SHORTEST),
        ):
            base, step = self._base, self._step
            slope = self.newton.descent(x, projection, base, step)
            length = self._length(base, step, shortest, slope) if slope > 0.0 else 0.0
            if not length:
                continue
            if projection and length == 1.0:
                length = self._stretched(base, step)
            y.waxpy(-1.0, base, x)
            y.axpy(length, step)
            self.newton.note(f"reset, {tangent} tangent, step {length:g}")
            if projection and (length > 1.0 if absolute else length < WORTHWHILE):
                self._projection = 3 - self._projection
            return True
        self.newton.halted = Reason.DIVERGED_LINE_SEARCH
        return False

    def _length(self, base: PETSc.Vec, step: PETSc.Vec, shortest: float, slope: float) -> float:
        """How much of a step to take from a state: as much as brings what the slope promises.

        Args:
            base: Scaled unknowns.
            step: What is subtracted from them.
            shortest: The least to try.
            slope: Of the energy; 0 for any fall, or a change that is rounding error.

        Returns:
            1, 1/2, 1/4, ...; 0 if none will do.
        """
        trial, length = self._trial, 1.0
        while length >= shortest:
            trial.waxpy(-length, step, base)
            phi = self.newton.merit(trial)
            same = not slope and abs(phi - self._phi) < ENERGY_RESOLVED * abs(self._phi)
            falls = phi < self._phi if not slope else phi <= self._phi - ARMIJO * length * slope
            if falls or same:
                self._phi = phi
                return length
            length /= 2
        return 0.0

    def _stretched(self, base: PETSc.Vec, step: PETSc.Vec) -> float:
        """Twice the step as long as that brings more: positive tangents are too stiff."""
        trial, length = self._trial, 1.0
        while length < LONGEST:
            trial.waxpy(-2 * length, step, base)
            phi = self.newton.merit(trial)
            if phi >= self._phi:
                break
            self._phi, length = phi, 2 * length
        return length
