"""Solving with the condensed matrix K: conjugate gradients as long as they pay, or factors."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from solvers.condensation import Condensation
from solvers.lifetime import Factors
from solvers.linear import LINEAR_REASONS, forget_factors
from solvers.options import (
    FACTORISE_UP_TO,
    FORCING_LIMITS,
    KEEP_WHILE,
    MODEST,
    PATIENCE,
    RESOLVED,
)

_FACTORISATIONS = ("lu", "cholesky", "svd", "redundant", "telescope", "python")

_NEGATIVE = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
_INDEFINITE_PC = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC


class Outcome(Enum):
    """Of an attempt to solve with K."""

    SOLVED, NEGATIVE, FAILED = range(3)


class InnerSolver:
    """Solves with K, in a Newton iteration as exactly as that can use.

    A preconditioner is kept from one Newton iteration to the next as long as it serves. Where an
    iterative solver takes longer than factors would, LDLᵀ takes its place, for some iterations
    before it is tried again. Where there is negative curvature, the system is solved with a
    positive semi-definite stand-in for K if the blocks have one.

    Attributes:
        ksp: PETSc's solver, with the prefix given.
        iterations: Linear iterations since the last `start`.
        seconds: Wall time since then by phase: "condensation", "setup" of the preconditioner,
            "solve".
        target: The residual norm at which the Newton iteration ends.
        notes: What was done since then that is not usual, by the number of the Newton iteration.
        failure: Why the last system could not be solved, as far as that is known.
        unstable: What the last solve has shown of K that no stable state has; see `LinearSolver`.
    """

    def __init__(self, comm: MPI.Comm, prefix: str, *, symmetric: bool, bs: int) -> None:
        """Take the options under a prefix.

        Args:
            comm: Communicator.
            prefix: Of PETSc's options.
            symmetric: Whether K is.
            bs: Its block size.

        Raises:
            ValueError: Options that do not go together.
        """
        self.ksp = PETSc.KSP().create(comm)
        self.ksp.setOptionsPrefix(prefix)
        self.ksp.setFromOptions()
        pc = self.ksp.getPC().getType()
        self._direct = self.ksp.getType() == PETSc.KSP.Type.PREONLY
        if self._direct and pc not in _FACTORISATIONS:
            raise ValueError(
                f"condensed_pc_type is {pc!r}, which solves no system by itself; add "
                "condensed_ksp_type=cg, or gmres"
            )
        self._symmetric = symmetric
        self._right = Factors(comm, self)
        # Block by block a product takes less than half the time. The preconditioner is K's own.
        self._by_blocks = PETSc.Mat() if not self._direct and bs > 1 else None
        self._state = -1
        self._keep, self._fresh_cost = False, 0.0
        self._factors: PETSc.KSP | None = None
        self._factorise, self._patience = 0, PATIENCE
        self.start()

    def destroy(self) -> None:
        """Destroy PETSc's objects."""
        for thing in (self.ksp, self._by_blocks, self._factors):
            if thing is not None:
                thing.destroy()

    def start(self) -> None:
        """Begin a new nonlinear solve."""
        self.iterations = 0
        self.seconds = {"condensation": 0.0, "setup": 0.0, "solve": 0.0}
        self.notes: dict[int, str] = {}
        self.target = 0.0
        self.failure = self.unstable = ""
        self._newton_iteration = 0
        self._counted, self._negative = False, 0
        self._norms: list[float] = []

    def restart(self) -> None:
        """Begin again from the start of a nonlinear solve."""
        self._keep = False
        self._norms = []

    def carried(self) -> dict[str, float]:
        """For how many more systems factors replace CG, and for how many the next time."""
        return {"factorise": self._factorise, "patience": self._patience}

    def carry(self, numbers: Mapping[str, float]) -> None:
        """Take these from another solver."""
        self._factorise, self._patience = int(numbers["factorise"]), int(numbers["patience"])

    def renew(self) -> None:
        """Forget preconditioners, their interpolation too, and factors. Collective."""
        self._keep, self._fresh_cost = False, 0.0
        for ksp in (self.ksp, self._factors):
            if ksp is not None:
                forget_factors(ksp)

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add to the seconds of a phase."""
        start = time.perf_counter()
        yield
        self.seconds[phase] += time.perf_counter() - start

    def solve(
        self, blocks: Condensation, g: PETSc.Vec, z: PETSc.Vec, norm: float, *, exact: bool
    ) -> bool:
        """Solve K z = g, or with what may stand for K. Collective.

        Args:
            blocks: Have K, and perhaps stand-ins.
            g: Right-hand side.
            z: Solution.
            norm: Of the block system's right-hand side.
            exact: Whether K is the second derivative of an energy of positions.

        Returns:
            Whether that succeeded; else `failure` says why not.
        """
        self._blocks, self._g, self._z = blocks, g, z
        self._newton_iteration += 1
        self._set_tolerance(norm)
        self._tried: list[str] = []
        outcome = self._attempt(keep=self._keep)
        self.unstable = self._instability() if exact else ""
        small = blocks.K.size[0] <= FACTORISE_UP_TO
        while outcome is Outcome.NEGATIVE or (outcome is Outcome.FAILED and not small):
            with self.timed("condensation"):
                if not blocks.project():
                    break
            what = "negative curvature" if outcome is Outcome.NEGATIVE else "no convergence of CG"
            self._note(f"{what}: projected tangent")
            # A stand-in may be near to K, and more than one may be needed.
            outcome = self._attempt(keep=outcome is Outcome.NEGATIVE)
            self._keep = False  # it is that of another matrix
        if outcome is Outcome.NEGATIVE and small and not self._counted:
            self._note("negative curvature: " + self._factorisation)
            outcome = self._factorised()
        if outcome is Outcome.SOLVED or (outcome is Outcome.NEGATIVE and self._counted):
            return True  # the last stand-in is as good as there is
        self.failure = "; ".join(self._tried)
        return False

    def _attempt(self, *, keep: bool) -> Outcome:
        """Solve with K as it is."""
        if self._direct:
            return self._solved(self.ksp)
        if self._factorise > 0:
            self._factorise -= 1
            self._note(f"{self._factorisation}, as CG took too long before")
            return self._factorised()
        small = self._blocks.K.size[0] <= FACTORISE_UP_TO
        outcome = self._iterated(keep=keep)
        long = self.ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT
        if keep and outcome is not Outcome.SOLVED and not (long and small):
            outcome = self._iterated(keep=False)
        if small and self.ksp.getConvergedReason() == _INDEFINITE_PC:
            # Whether that comes from K, factors can tell.
            outcome = self._factorised()
            negative = self._counted and self._negative > 0
            what = "negative curvature" if negative else "indefinite preconditioner"
            self._note(f"{what}: {self._factorisation}")
            return Outcome.NEGATIVE if negative else outcome
        if outcome is Outcome.SOLVED:
            self._patience = PATIENCE
        if outcome is not Outcome.FAILED or not small:
            return outcome
        self._factorise, self._patience = self._patience, 2 * self._patience
        self._note(f"no convergence of CG: {self._factorisation}")
        return self._factorised()

    def _iterated(self, *, keep: bool) -> Outcome:
        """Solve by the iterative solver."""
        ksp, K = self.ksp, self._blocks.K
        self._counted = False
        ksp.getPC().setReusePreconditioner(keep)
        with self.timed("setup"):
            if self._by_blocks is not None and self._state != K.stateGet():
                K.convert(PETSc.Mat.Type.BAIJ, self._by_blocks)
                self._by_blocks.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric)
                self._state = K.stateGet()
            # Without new operators `setUp` would leave the preconditioner to `solve`.
            ksp.setOperators(self._by_blocks or K, K)
            ksp.setUp()
            ksp.setUpOnBlocks()
        with self.timed("solve"):
            ksp.solve(self._g, self._z)
        its = ksp.getIterationNumber()
        self.iterations += its
        solved = ksp.getConvergedReason() > 0
        cost = its / -np.log10(ksp.getTolerances()[0])
        if not keep:
            self._fresh_cost = cost
        self._keep = solved and cost <= KEEP_WHILE * self._fresh_cost
        if solved:
            return Outcome.SOLVED
        self._failed(f"{ksp.getType()}: {LINEAR_REASONS[ksp.getConvergedReason()]}")
        indefinite = ksp.getConvergedReason() in (_NEGATIVE, _INDEFINITE_PC)
        return Outcome.NEGATIVE if indefinite else Outcome.FAILED

    def _factorised(self) -> Outcome:
        """Solve by factors in the place of the iterative solver."""
        if self._factors is None:
            self._factors = PETSc.KSP().create(self.ksp.comm)
            self._factors.setType(PETSc.KSP.Type.PREONLY)
            pc = self._factors.getPC()
            pc.setType(PETSc.PC.Type.CHOLESKY if self._symmetric else PETSc.PC.Type.LU)
            pc.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
            self._factors.setOperators(self._blocks.K)
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setMumpsIcntl(13, 1)  # counts all negative pivots, on any ranks
        return self._solved(self._factors)

    def _solved(self, factors: PETSc.KSP) -> Outcome:
        """Solve by factors."""
        with self.timed("setup"):
            factors.setOperators(self._blocks.K)
            factors.setUp()
        with self.timed("solve"):
            factors.solve(self._g, self._z)
        self._right.used()
        self.iterations += factors.getIterationNumber()
        self._counted = factors.getConvergedReason() > 0
        if not self._counted:
            self._failed(f"the condensed matrix has {forget_factors(factors)}")
            return Outcome.FAILED
        self._negative = _negative_pivots(factors)
        wanting = self._blocks.definite and self._negative > 0
        return Outcome.NEGATIVE if wanting else Outcome.SOLVED

    @property
    def _factorisation(self) -> str:
        return "LDLᵀ" if self._symmetric else "LU"

    def _instability(self) -> str:
        """What the last attempt has shown of K, the second derivative of an energy."""
        if not self._counted:
            negative = self.ksp.getConvergedReason() == _NEGATIVE
            return "negative curvature" if negative else ""
        count = self._negative
        return f"{count} negative eigenvalue{'s' if count > 1 else ''}" if count else ""

    def _note(self, what: str) -> None:
        self.notes[self._newton_iteration] = what

    def _failed(self, how: str) -> None:
        """Remember how the first attempts failed, each way once."""
        if how not in self._tried:
            self._tried.append(how)

    def _set_tolerance(self, norm: float) -> None:
        """Solve as exactly as this Newton step can use.

        What the condensed system leaves is what the block system leaves. Choice 2 of Eisenstat and
        Walker (1996), and no more than what ends the Newton iteration (Kelley 1995, eq. 6.20), but
        with two differences.

        A residual that has grown is no licence to leave more of it. The linearised turn of a stiff
        body stretches it, so that in the second iteration forces are larger than the loads by the
        ratio of stiffness to inertia; an error of a thousandth of them would be a stress far above
        what the loads make, and the next iterations would be about that. So tolerances are relative
        to the least residual so far.

        And the more it has grown, the softer are the motions that forces hardly show: an error δu
        of such a motion, with little force K δu, is a stress E |∇δu| in the next iteration. The
        square root of the growth is to energy what the growth is to force.

        Args:
            norm: Of the block system's right-hand side.
        """
        loose, tight = FORCING_LIMITS
        least = min(self._norms, default=norm)
        self._norms.append(norm)
        growth = max(self._norms) / self._norms[0] if norm > 0.0 else 1.0
        forcing = (norm / least) ** ((1 + 5**0.5) / 2) if least > 0.0 else loose
        forcing = np.clip(forcing, tight, max(loose / np.sqrt(growth), tight))
        condensed = self._g.norm()
        if condensed > 0.0:
            enough = max(forcing * min(norm, least), 0.1 * self.target) / condensed
            smallest = RESOLVED * np.finfo(float).eps
            self.ksp.setTolerances(rtol=float(np.clip(enough, smallest, MODEST)))


def _negative_pivots(factors: PETSc.KSP) -> int:
    """Of LDLᵀ, as many as the matrix has negative eigenvalues; 0 if nothing counts them."""
    pc = factors.getPC()
    counts = pc.getType() == PETSc.PC.Type.CHOLESKY
    if not counts or pc.getFactorSolverType() != PETSc.Mat.SolverType.MUMPS:
        return 0
    return int(pc.getFactorMatrix().getMumpsInfog(12))
