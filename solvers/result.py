"""What a solve returns, and what it raises when it fails."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class History:
    """What happened in a solve, iteration by iteration; see `SolveResult`."""

    norms: list[dict[str, float]] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    krylov: list[int] = field(default_factory=list)
    inner: list[int] = field(default_factory=list)
    notes: dict[int, str] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=lambda: {"residual": 0.0, "jacobian": 0.0})


@dataclass(frozen=True)
class SolveResult:
    """A converged Newton solve.

    Attributes:
        iterations: Number of Newton iterations.
        krylov: Number of linear iterations of each Newton iteration.
        reason: PETSc's name of the reason for stopping, such as "CONVERGED_FNORM_RELATIVE".
        norms: For the starting point and each Newton iteration, the Euclidean norm of every
            field's residual by field name, in the field's own units (J over the field's unit).
        residuals: The norm that Newton's method itself sees at the same points: of all residuals
            together, each scaled to make the blocks of the Jacobian comparable. Dimensionless up to
            a common factor; rates of convergence are read from it.
        timings: Wall seconds on this rank by phase: "residual", "jacobian", "solve", "total", and
            "condensation" where cell-local fields are eliminated, "setup" of the preconditioner
            where the condensed solver makes one.
        notes: What the linear solver had to say, by the number of the Newton iteration.
        unstable: What tells that the state is no minimum of the energy, such as "1 negative
            eigenvalue" of the condensed matrix; empty if nothing does. Of the matrix of the last
            iteration: LDLᵀ counts, conjugate gradients may meet negative curvature.
        inner: With block preconditioners, of each Newton iteration the number of iterations on the
            condensed matrix, all its solves together; of applications, if it has no iteration.
    """

    iterations: int
    krylov: list[int]
    reason: str
    norms: list[dict[str, float]] = field(repr=False)
    residuals: list[float] = field(repr=False)
    timings: dict[str, float] = field(repr=False)
    notes: dict[int, str] = field(default_factory=dict, repr=False)
    inner: list[int] = field(default_factory=list, repr=False)
    unstable: str = ""

    @property
    def krylov_iterations(self) -> int:
        """Number of linear iterations over all Newton iterations."""
        return sum(self.krylov)


class ConvergenceError(RuntimeError):
    """A Newton solve failed; the fields hold what they held before it.

    Attributes:
        result: The iterations, reason and norms up to the failure.
    """

    def __init__(self, result: SolveResult) -> None:
        self.result = result
        super().__init__(f"Newton's method failed: {result.reason}\n{history_table(result)}")


def history_table(result: SolveResult) -> str:
    """Return the residual norms of each iteration as lines of text."""
    names = list(result.norms[0]) if result.norms else []
    header = f"{'it':>4}  {'residual':>9}  " + "  ".join(f"{'|r_' + n + '|':>9}" for n in names)
    rows = (
        f"{k:4d}  {residual:9.2e}  "
        + "  ".join([*(f"{norms[n]:9.2e}" for n in names), *filter(None, [result.notes.get(k)])])
        for k, (residual, norms) in enumerate(zip(result.residuals, result.norms, strict=True))
    )
    return "\n".join([header, *rows])
