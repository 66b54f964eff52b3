"""Strategies that keep Newton's method from diverging."""

from solvers.strategies.base import Strategy
from solvers.strategies.continuation import Continuation
from solvers.strategies.descent import (
    AbsoluteNewton,
    Descent,
    FilteredNewton,
    KineticNewton,
    LocalGlobal,
    ProgressiveNewton,
    ProjectedNewton,
    ProjectOnDemand,
)
from solvers.strategies.full_steps import FullSteps, ResidualSearch
from solvers.strategies.watchdog import Watchdog

_DESCENTS: tuple[type[Descent], ...] = (
    ProjectOnDemand,
    KineticNewton,
    ProgressiveNewton,
    ProjectedNewton,
    AbsoluteNewton,
    FilteredNewton,
    LocalGlobal,
)

STRATEGIES: dict[str, type[Strategy]] = {
    "watchdog": Watchdog,
    "full-steps": FullSteps,
    "residual-search": ResidualSearch,
    "continuation": Continuation,
    **{strategy.name: strategy for strategy in _DESCENTS},
}
"""Strategies by name, the default first. The first line of a docstring describes its class."""

__all__ = ["STRATEGIES", "Strategy"]
