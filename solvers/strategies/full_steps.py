"""Full steps, and a line search on the residual where they fail."""

from __future__ import annotations

from solvers.newton import Newton
from solvers.options import DIVERGING, MOST_FULL_STEPS
from solvers.strategies.base import Strategy


class FullSteps(Strategy):
    """Full steps, whatever becomes of the residual."""


def until_divergence(newton: Newton) -> bool:
    """Take full steps until they converge or diverge; whether they converge. Collective."""
    return newton.iterate(growth=DIVERGING, most=MOST_FULL_STEPS)


class ResidualSearch(Strategy):
    """Full steps; where they diverge, from the start again with a line search on the residual.

    The search minimises the residual along each step, or with the displacement alone backtracks. A
    line search that the user chooses takes the place of both.
    """

    def attach(self, newton: Newton) -> None:
        """Look at the user's choice."""
        super().attach(newton)
        self._may_search = newton.snes.getLineSearch().getType() == "basic"

    def solve(self) -> bool:
        """Take full steps; if they diverge, start again with a line search. Collective."""
        if not self._may_search:
            return self.newton.iterate()
        if until_divergence(self.newton):
            return True
        return not self.newton.exhausted and self._search()

    def _search(self) -> bool:
        newton = self.newton
        newton.restart("full steps diverge: from the start again, with a line search")
        search = newton.snes.getLineSearch()
        search.setType("bt" if newton.alone else "l2")
        try:
            return newton.iterate(growth=DIVERGING)
        finally:
            search.setType("basic")
