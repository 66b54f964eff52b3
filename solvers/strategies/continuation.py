"""Continuation: what is out of balance at the start of a solve is let in part by part."""

from __future__ import annotations

from solvers.newton import Newton
from solvers.options import (
    CLOSE,
    DIVERGING,
    EASY,
    FIRST_PART,
    MOST_OF_A_PART,
    SMALLEST_PART,
)
from solvers.strategies.base import Strategy
from solvers.strategies.full_steps import until_divergence


class Continuation(Strategy):
    """Full steps; where they diverge, loads and motions let in part by part from the start.

    With r₀ the residual at the start and t from 0 to 1, r = (1 - t) r₀ is solved by full steps for
    one t after another, each from the solution before. Loads, inertia and the values of Dirichlet
    conditions all come in that way.
    """

    def attach(self, newton: Newton) -> None:
        """Make room for a solution."""
        super().attach(newton)
        self._solution = newton.vector()

    def solve(self) -> bool:
        """Take full steps; if they diverge, start again part by part. Collective."""
        newton = self.newton
        if until_divergence(newton):
            return True
        if newton.exhausted:
            return False
        newton.restart("full steps diverge: from the start again, part by part")
        return self.let_in()

    def let_in(self, smallest: float = SMALLEST_PART) -> bool:
        """Go from the start of the solve to its end part by part. Collective.

        Args:
            smallest: The smallest part that is tried.

        Returns:
            Whether this has reached the end; else the unknowns are where it has come.
        """
        newton, x = self.newton, self.newton.system.x
        whole = newton.keep_start()
        done, part = 0.0, FIRST_PART
        try:
            while done < 1.0 and not newton.exhausted and part >= smallest:
                x.copy(self._solution)
                t, before = min(done + part, 1.0), newton.iterations
                newton.withhold(1.0 - t)
                enough = CLOSE * part * whole if t < 1.0 else 0.0
                if newton.iterate(growth=DIVERGING**2, most=MOST_OF_A_PART, enough=enough):
                    done = t
                    if newton.iterations - before <= EASY:
                        part *= 2.0
                    newton.note(f"{t:.3g} of the whole", last=True)
                else:
                    self._solution.copy(x)
                    part /= 2.0
        finally:
            newton.withhold(0.0)
        return done == 1.0
