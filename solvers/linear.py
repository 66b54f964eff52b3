"""What Newton's method asks of a linear solver, and PETSc's Krylov solver as it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from mpi4py import MPI
from petsc4py import PETSc

from solvers.lifetime import Factors


class LinearSolver(Protocol):
    """Solves the Newton system.

    Attributes:
        target: The residual norm at which the Newton iteration ends.
    """

    target: float

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time since the last `start` by phase, if phases are told apart."""

    @property
    def notes(self) -> dict[int, str]:
        """What was done since then that is not usual, by the number of the Newton iteration."""

    @property
    def unstable(self) -> str:
        """What the last solve has shown of the matrix that no stable state has, or nothing.

        Such as "2 negative eigenvalues" or "negative curvature".
        """

    def start(self) -> None:
        """Begin a new nonlinear solve."""

    def restart(self) -> None:
        """Begin again from the start of a nonlinear solve."""

    def carried(self) -> dict[str, float]:
        """Numbers that one nonlinear solve leaves for the next."""

    def carry(self, numbers: Mapping[str, float]) -> None:
        """Take such numbers for one's own."""

    def renew(self) -> None:
        """Keep nothing else of the former solves than these numbers. Collective."""

    def set_up(self, A: PETSc.Mat) -> PETSc.Mat:
        """Prepare for a Jacobian that is assembled, once the units are known. Collective.

        Returns:
            The matrix that PETSc is to build the preconditioner of.
        """

    def follow(self) -> None:
        """Follow the Jacobian, which has changed. Collective."""

    def count(self) -> tuple[int, int | None]:
        """Iterations of the Newton iteration just made: outer ones, inner ones if there are any."""

    def why(self) -> str:
        """What is known about why the last system could not be solved."""


class KrylovSolver:
    """PETSc's Krylov solver, with what its options say."""

    def __init__(self, ksp: PETSc.KSP, comm: MPI.Comm) -> None:
        self._ksp = ksp
        self._right = Factors(comm, self)
        self.seconds: dict[str, float] = {}
        self.notes: dict[int, str] = {}
        self.target = 0.0
        self.unstable = ""

    def start(self) -> None:
        """Nothing."""

    def restart(self) -> None:
        """Nothing."""

    def carried(self) -> dict[str, float]:
        """Nothing."""
        return {}

    def carry(self, numbers: Mapping[str, float]) -> None:
        """Nothing."""

    def renew(self) -> None:
        """Forget the factors. Collective."""
        forget_factors(self._ksp)

    def set_up(self, A: PETSc.Mat) -> PETSc.Mat:
        """Nothing; the preconditioner is that of the Jacobian."""
        return A

    def follow(self) -> None:
        """Nothing."""

    def count(self) -> tuple[int, int | None]:
        """Iterations of the last solve."""
        self._right.used()
        return int(self._ksp.getIterationNumber()), None

    def why(self) -> str:
        """What the factorisation says."""
        return forget_factors(self._ksp)


def forget_factors(ksp: PETSc.KSP) -> str:
    """Have a matrix that could not be factorised factorised from scratch the next time.

    PETSc 3.25 would not try again, and go on to solve with what there is not.

    Returns:
        What happened, in PETSc's words.
    """
    pc = ksp.getPC()
    reason = _FAILURES.get(pc.getFailedReason(), "no factors")
    operators = ksp.getOperators()
    pc.reset()
    ksp.setOperators(*operators)
    return reason


def names_of(reasons: type) -> dict[int, str]:
    """PETSc's names of its reasons for stopping."""
    return {
        value: name
        for name, value in vars(reasons).items()
        if isinstance(value, int) and name.startswith(("CONVERGED", "DIVERGED"))
    }


LINEAR_REASONS = names_of(PETSc.KSP.ConvergedReason)
"""PETSc's names of the reasons for the end of a linear solve."""

_FAILURES = {
    value: name for name, value in vars(PETSc.PC.FailedReason).items() if isinstance(value, int)
}
