"""Time stepping."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from solvers.problem import MixedProblem
from solvers.result import SolveResult


class TimeScheme(Protocol):
    """What `march` asks of a time scheme."""

    def advance(self) -> None:
        """Take the current unknowns as the end of the step."""


def march(problem: MixedProblem, scheme: TimeScheme, steps: int) -> Iterator[SolveResult]:
    """Solve and advance `steps` times, yielding the result of each step.

    Raises:
        ConvergenceError: A step failed; the scheme and the fields are as after the step before.
    """
    for _ in range(steps):
        result = problem.solve()
        scheme.advance()
        yield result
