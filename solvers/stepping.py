"""Time stepping, with steps of one length or of lengths that are found on the way."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from solvers.problem import MixedProblem
from solvers.result import ConvergenceError, SolveResult

logger = logging.getLogger("mixed_fem")


class TimeScheme(Protocol):
    """What `march` asks of a time scheme.

    Attributes:
        h: Time step [s], a constant whose `value` may be changed.
        t: Time at the start of the step [s].
    """

    h: Any
    t: float

    def advance(self) -> None:
        """Take the current unknowns as the end of the step."""

    def local_error(self) -> float:
        """Estimate the error that this step makes [m]. Collective."""


class Stepped(Protocol):
    """What `march` asks of a model; `forms.Model` is one."""

    def update(self, scheme: Any) -> None:
        """Put all data that depend on time where the scheme takes them in the coming step."""

    def accept(self, scheme: Any) -> None:
        """Take the current unknowns as the end of the step, and advance the scheme."""


@dataclass(frozen=True)
class StepControl:
    """When a step is made anew with a shorter one in its place.

    Attributes:
        cuts: How many times h may be halved where a solve fails, or the error is too large. Later
            steps grow again, by a factor of 2 at most.
        tolerance: Error of a step [m], to which h is fitted, with no upper bound; without one h
            grows no further than it was at first, and all multiples of that are met.
    """

    cuts: int = 10
    tolerance: float | None = None

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: A value is negative.
        """
        if self.cuts < 0:
            raise ValueError(f"cuts is {self.cuts}; it must be a whole number of 0 or more")
        if self.tolerance is not None and not self.tolerance > 0.0:
            raise ValueError(f"tolerance is {self.tolerance}; it must be a length above 0 [m]")

    def factor(self, error: float, order: int) -> float:
        """By what to multiply h, after a step of some error."""
        if self.tolerance is None or error == 0.0:
            return GROWTH
        return min(GROWTH, max(1 / 5, 0.9 * (self.tolerance / error) ** (1 / (order + 1))))


GROWTH = 2.0


@dataclass
class Pace:
    """Where `march` stands between steps, so that another can go on from there.

    Attributes:
        begin: Time at which it began [s], or None before.
        h: Length of the step that it will try next [s], or None before.
    """

    begin: float | None = None
    h: float | None = None


def march(
    problem: MixedProblem,
    scheme: TimeScheme,
    steps: int,
    model: Stepped | None = None,
    control: StepControl | None = None,
    pace: Pace | None = None,
) -> Iterator[SolveResult]:
    """Solve and advance over `steps` times h, yielding the result of each step.

    Args:
        problem: The Newton system.
        scheme: The time scheme. With a tolerance its `order` is asked for.
        steps: How many; of those that are made there may be more or fewer, see `control`.
        model: What is updated before each step, and accepts it; without one the scheme advances.
        control: How h changes, which by default it does not. When all is done it is as before.
        pace: Follows it. One that another march has left is gone on from: `steps` then counts from
            where that began, and h is what it was then.

    Raises:
        ValueError: A negative number of steps.
        ConvergenceError: A step failed, at the smallest h too; the scheme and the fields are as
            after the step before.
    """
    if steps < 0:
        raise ValueError(f"steps is {steps}; it must be a whole number of 0 or more")
    pace = Pace() if pace is None else pace
    if pace.begin is None:
        pace.begin = scheme.t
    if control is None:
        h = float(scheme.h.value)
        for _ in range(steps - round((scheme.t - pace.begin) / h)):
            if model is not None:
                model.update(scheme)
            result = problem.solve()
            _accept(scheme, model)
            yield result
        return
    nominal = float(scheme.h.value)
    try:
        yield from _controlled(problem, scheme, steps, nominal, model, control, pace)
    finally:
        scheme.h.value = nominal


def _controlled(
    problem: MixedProblem,
    scheme: TimeScheme,
    steps: int,
    nominal: float,
    model: Stepped | None,
    control: StepControl,
    pace: Pace,
) -> Iterator[SolveResult]:
    """Between multiples of the nominal h, or to the end at one go."""
    begin, smallest = pace.begin or 0.0, nominal / 2.0**control.cuts
    targets = range(1, steps + 1) if control.tolerance is None else [steps]
    h = nominal if pace.h is None else pace.h
    for target in targets:
        end = begin + target * nominal
        while (left := end - scheme.t) > 1e-9 * nominal:
            tried = left if left <= 1.001 * h else h
            if control.tolerance is not None and h < left < 2 * h:
                tried = max(left / 2, smallest)  # twice, so that no last step is very short
            scheme.h.value = tried
            result, factor = _tried(problem, scheme, model, control, last=tried <= smallest)
            if result is None:
                h = max(tried * factor, smallest)
                continue
            _accept(scheme, model)
            h = max(h, factor * tried) if control.tolerance is None else factor * tried
            h = min(h, nominal) if control.tolerance is None else max(h, smallest)
            pace.h = h
            yield result


def _tried(
    problem: MixedProblem,
    scheme: TimeScheme,
    model: Stepped | None,
    control: StepControl,
    *,
    last: bool,
) -> tuple[SolveResult | None, float]:
    """The result of a step, None if it is to be made anew, and by what to multiply h."""
    before = [f.x.array.copy() for f in problem.fields]
    if model is not None:
        model.update(scheme)
    try:
        result = problem.solve()
    except ConvergenceError:
        if last:
            raise
        return None, 0.5
    if control.tolerance is None:
        return result, GROWTH
    error = scheme.local_error()
    factor = control.factor(error, getattr(scheme, "order", 1))
    if error <= control.tolerance or last:
        if error > control.tolerance and problem.fields[0].function_space.mesh.comm.rank == 0:
            h, least = float(scheme.h.value), f"{error:.1e} m at the smallest"
            logger.warning("the error of a step is %s h, %g s", least, h)
        return result, factor
    for f, values in zip(problem.fields, before, strict=True):
        f.x.array[:] = values
    return None, min(factor, 0.9)


def _accept(scheme: TimeScheme, model: Stepped | None) -> None:
    if model is None:
        scheme.advance()
    else:
        model.accept(scheme)
