"""Descents on the energy: Newton's method on the displacement as it is practised."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from solvers.engine.system import EngineProblem
from solvers.lifetime import weakly
from solvers.newton import Newton
from solvers.options import ARMIJO, LAGGED, ROUNDING, SHORTEST
from solvers.stopping import Reason
from solvers.strategies.base import Strategy


class Descent(Strategy):
    """The exact tangent, the positive semi-definite one where it is not, and Armijo's condition.

    Where rounding error hides what a short step does to the energy, the slope at its end decides
    (Hager and Zhang, 2005, section 2.1). Cell-local fields, if there are any, are after each step
    where the energy is stationary in them.

    Attributes:
        name: In `STRATEGIES`.
        shrink: What the search multiplies steps by.
        projection: Of the tangents of all iterations, see `EngineProblem`.
        alone: Whether it is for the displacement alone.
        longest: How many times a step of a projected tangent may be taken.
        farthest: How many times the body's size a step may move a point.
        system: That of Newton's method.
        energy: At the unknowns [J].
    """

    name = "descent"
    shrink = 0.5
    projection = 0
    alone = True
    longest, farthest = 1.0, np.inf

    def attach(self, newton: Newton) -> None:
        """Insist on an energy."""
        super().attach(newton)
        name = f"globalisation {self.name!r}"
        if self.alone and not newton.alone:
            raise ValueError(f"{name} needs the displacement alone as field")
        if not newton.system.descends:
            raise ValueError(f"{name} goes down on the energy: it needs the engine and no work")
        assert isinstance(newton.system, EngineProblem)  # no other can
        self.system = newton.system
        self._trial, self._slopes = newton.vector(), newton.vector()

    def solve(self) -> bool:
        """Iterate. Collective."""
        self.newton.meet_conditions(self.system.x)
        return self.descend()

    def descend(self, most: int | None = None) -> bool:
        """Iterate from unknowns that meet the conditions. Collective.

        Args:
            most: Iterations.
        """
        x = self.system.x
        self.energy = self.newton.merit(x)
        self.system.unknowns.read(x)
        self._noise = self._rounding(x)
        self.system.projection = self.projection
        self.begin()
        return self.newton.iterate(most=most)

    def begin(self) -> None:
        """Forget the last solve."""

    def accepted(self, x: PETSc.Vec, y: PETSc.Vec, slope: float, change: float) -> None:
        """Learn from a step, that from x to x - y. Collective.

        Args:
            x: Scaled unknowns where it begins.
            y: The step.
            slope: Derivative of the energy along it.
            change: Of the energy.
        """

    def before_step(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Shorten the step until the energy falls enough. Collective; called by PETSc."""
        newton = self.newton
        slope = self._slope(y)
        if slope == 0.0:
            return False
        while slope < 0.0:
            if t := self._search(x, y, slope):
                return t != 1.0 or not newton.alone
            # A body that turns has rounding errors that it does not have at rest.
            noise = self._rounding(x)
            if noise <= self._noise:
                break
            self._noise = noise
        newton.halted = Reason.DIVERGED_LINE_SEARCH
        y.set(0.0)
        return True

    def _search(self, x: PETSc.Vec, y: PETSc.Vec, slope: float) -> float:
        """Shorten a step; return by how much, 0 if no length will do."""
        energy, first = self.energy, 1.0
        if np.isfinite(self.farthest):
            moved = self.system.unknowns.largest_move(y) / self.newton.size
            first = 1.0 if moved <= self.farthest else self.farthest / moved
        t = first
        while t > SHORTEST * first:
            self._trial.waxpy(-t, y, x)
            change = self.newton.merit(self._trial) - energy
            if change <= ARMIJO * t * slope or self._flat(change, y, slope):
                self.energy = energy + change
                if self.system.projection and t == 1.0:
                    t = self._stretched(x, y)
                y.scale(t)
                self.accepted(x, y, t * slope, change)
                if not self.newton.alone:  # the fields are relaxed
                    self.system.unknowns.read(self._trial)
                    y.waxpy(-1.0, self._trial, x)
                return t
            t *= self.shrink
        return 0.0

    def _stretched(self, x: PETSc.Vec, y: PETSc.Vec) -> float:
        """Take twice the step as long as that brings more; return how many times."""
        length = 1.0
        while length < self.longest:
            self._trial.waxpy(-2 * length, y, x)
            energy = self.newton.merit(self._trial)
            if energy >= self.energy:
                self._trial.waxpy(-length, y, x)
                self.newton.merit(self._trial)
                break
            self.energy, length = energy, 2 * length
        if length > 1.0:
            self.newton.note(f"step {length:g}")
        return length

    def _slope(self, y: PETSc.Vec) -> float:
        """The energy's along a step, which becomes that of a stand-in if it goes up."""
        system = self.system
        slope = -system.b.dot(y)
        while slope > 0.0 and system.project():
            self.newton.snes.getKSP().solve(system.b, y)
            slope = -system.b.dot(y)
        if slope > 0.0:  # rounding error of a tangent that is all but singular
            y.scale(-1.0)
        return -abs(float(slope))

    def _flat(self, change: float, y: PETSc.Vec, slope: float) -> bool:
        """Whether no more than rounding tells the energy apart, and the slope is not steeper up."""
        if not self._is_rounding(change):
            return False
        self.system.residual(self._slopes)  # the fields are those of the trial
        return bool(-self._slopes.dot(y) <= (2 * ARMIJO - 1) * slope)

    def _is_rounding(self, change: float) -> bool:
        return abs(change) <= self._noise + ROUNDING * abs(self.energy)

    def _rounding(self, x: PETSc.Vec) -> float:
        """What rounding of positions does to the energy [J], at the scaled unknowns. Collective."""
        newton = self.newton
        x.copy(self._trial)
        size = newton.system.unknowns.round_off(x) / max(np.sqrt(x.getSize()), 1.0)
        first, last = x.getOwnershipRange()
        self._trial.array_w[:] += size * (-1.0) ** np.arange(first, last)
        change = newton.merit(self._trial) - self.energy
        return 100 * abs(change) if np.isfinite(change) else 0.0


class ProjectedNewton(Descent):
    """Eigenvalues of the tangent clamped to 0 at each point (Teran et al., 2005)."""

    name, projection = "projected-newton", 1


class AbsoluteNewton(Descent):
    """Absolute eigenvalues of the tangent at each point (Chen et al., 2024)."""

    name, projection = "absolute-newton", 2


class FilteredNewton(Descent):
    """Clamped eigenvalues where the last step fell as predicted, else absolute ones.

    Trust-region eigenvalue filtering (Chen et al., SIGGRAPH Asia 2024), with its search and
    threshold.
    """

    name, shrink = "filtered-newton", 0.8
    WITHIN = 0.01

    def begin(self) -> None:
        """Begin with absolute eigenvalues."""
        self._ratio = 0.0

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Choose."""
        self.system.projection = 1 if abs(self._ratio - 1.0) < self.WITHIN else 2

    def accepted(self, x: PETSc.Vec, y: PETSc.Vec, slope: float, change: float) -> None:
        """Compare with what the exact tangent predicts."""
        system = self.system
        projection, system.projection = system.projection, 0
        self.newton.merit(x)  # puts x into the fields
        system.assemble()
        system.projection = projection
        system.K.mult(y, self._trial)
        predicted = slope + y.dot(self._trial) / 2
        resolved = predicted != 0.0 and not self._is_rounding(change)
        self._ratio = change / predicted if resolved else 1.0


class ProjectOnDemand(Descent):
    """The exact tangent; for a few iterations the projected one after negative curvature.

    Longva et al., "Pitfalls of Projection", 2023.
    """

    name = "project-on-demand"
    ITERATIONS = 4

    def begin(self) -> None:
        """Begin with the exact tangent; the projected one takes the place of one not definite."""
        self.system.stand_in = weakly(self._project)
        self._left = 0

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Choose."""
        self._left = max(self._left - 1, 0)
        self.system.projection = int(self._left > 0)

    def _project(self, attempt: int) -> bool:
        system = self.system
        if system.projection:
            return False
        self._left, system.projection = self.ITERATIONS, 1
        system.assemble()
        return True


class KineticNewton(Descent):
    """The exact tangent, with as much more inertia as makes it positive definite.

    Longva et al., "Pitfalls of Projection", 2023.
    """

    name = "kinetic-newton"
    GROWTH, MOST = 4.0, 1e12

    def begin(self) -> None:
        """Begin with the exact tangent; inertia is added to one that is not definite."""
        self.system.stand_in = weakly(self._add)
        self._more = 0.0

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Less than the last time."""
        self._more = self._more / self.GROWTH if self._more > 1.0 else 0.0
        self.system.inertia = 1.0 + self._more

    def _add(self, attempt: int) -> bool:
        self._more = max(self.GROWTH * self._more, 1.0)
        self.system.inertia = 1.0 + self._more
        self.system.assemble()
        return self._more < self.MOST


class ProgressiveNewton(Descent):
    """The exact tangent, projected where the residual is large, as far as needed.

    Progressively projected Newton (Fernández-Fernández et al., 2025), with its factors.
    """

    name = "progressive-newton"
    TIGHTEN, RELEASE, ALL = 0.5, 2.0, 1e-9

    def begin(self) -> None:
        """Begin with the exact tangent; more cells are projected where it is not definite."""
        self.system.stand_in = weakly(self._more)
        self._threshold = np.inf

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Fewer cells than the last time."""
        self._forces = self.system.forces()
        largest = self._forces.max(initial=0.0)
        self._largest = self.system.layout.comm.allreduce(largest, op=MPI.MAX)
        self._threshold *= self.RELEASE
        self._choose()

    def _more(self, attempt: int) -> bool:
        system = self.system
        if self._threshold <= self.ALL * self._largest:
            return False
        self._threshold = self.TIGHTEN * min(self._threshold, self._largest)
        self._choose()
        system.assemble()
        return True

    def _choose(self) -> None:
        system = self.system
        everywhere = self._threshold <= self.ALL * self._largest
        system.projection = 1
        system.marks = None if everywhere else (self._forces >= self._threshold).astype(np.int8)


class LocalGlobal(Descent):
    """A constant Laplacian in the place of the tangent, so that a step asks cells for forces alone.

    The local and the global step of projective dynamics (Bouaziz et al., 2014) in the form of Liu,
    Bouaziz and Kavan (2017), who weight cells by their stiffness in uniaxial strain.
    """

    name, projection, exact = "local-global", 3, False
    options = LAGGED
