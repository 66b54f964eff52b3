"""Solvers: an energy and its fields in, a converged state out. No physics here."""

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)

from solvers.checkpoint import Checkpoint, CheckpointError
from solvers.interruption import deferred, safe_point
from solvers.options import SOLVERS
from solvers.preconditioners import PRECONDITIONERS
from solvers.problem import MixedProblem, NewtonStep
from solvers.result import ConvergenceError, SolveResult
from solvers.stepping import Pace, StepControl, TimeScheme, march
from solvers.strategies import STRATEGIES, Strategy

__all__ = [
    "PRECONDITIONERS",
    "SOLVERS",
    "STRATEGIES",
    "Checkpoint",
    "CheckpointError",
    "ConvergenceError",
    "MixedProblem",
    "NewtonStep",
    "Pace",
    "SolveResult",
    "StepControl",
    "Strategy",
    "TimeScheme",
    "deferred",
    "march",
    "safe_point",
]
