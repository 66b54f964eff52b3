"""Solvers: an energy and its fields in, a converged state out. No physics here."""

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)

from solvers.compiled import CellKernel
from solvers.options import SOLVERS
from solvers.preconditioners import PRECONDITIONERS
from solvers.problem import MixedProblem
from solvers.result import ConvergenceError, SolveResult
from solvers.stepping import TimeScheme, march

__all__ = [
    "PRECONDITIONERS",
    "SOLVERS",
    "CellKernel",
    "ConvergenceError",
    "MixedProblem",
    "SolveResult",
    "TimeScheme",
    "march",
]
