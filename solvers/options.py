"""Default PETSc options. A user's own options, then the PETSc command line, override them."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping
from typing import ClassVar

from mpi4py import MPI
from petsc4py import PETSc

logger = logging.getLogger("mixed_fem")

Options = Mapping[str, str | int | float | bool | None]

NEWTON: Options = {
    # Full steps; `MixedProblem` puts a search in their place where they diverge.
    "snes_linesearch_type": "basic",
    # Relative to the first residual of the solve; one quadratic step below what users look at.
    "snes_rtol": 1e-10,
    # Residuals may grow a lot before they fall: S follows u with a delay of one iteration.
    "snes_divergence_tolerance": 1e100,
    # A small step is no sign of convergence.
    "snes_stol": 0.0,
    # Of all passes of a solve together.
    "snes_max_it": 200,
}
"""Newton's method."""

LAGGED: Options = {**NEWTON, "snes_lag_jacobian": 1_000_000, "snes_max_it": 1000}
"""With the matrix of the first iteration in all of them, which are many."""

DIRECT: Options = {
    "ksp_type": "preonly",
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
    # Zeros on the diagonal: pivoting fills in more than MUMPS foresees, in percent of that.
    "mat_mumps_icntl_14": 200,
    # Rows and columns in turn: with materials of very different stiffness less to pivot for.
    "mat_mumps_icntl_8": 8,
}
"""LU factorisation of the whole block system."""

CONDENSED: Options = {
    # The preconditioner eliminates the cell-local fields and is an exact solver.
    "ksp_type": "preonly",
    "pc_type": "python",
}
"""Static condensation; the condensed system has the prefix `condensed_`."""

CONDENSED_DIRECT: Options = {
    "ksp_type": "preonly",
    "pc_type": "cholesky",
    "pc_factor_mat_solver_type": "mumps",
    # Else MUMPS does not count all negative pivots on several ranks.
    "mat_mumps_icntl_13": 1,
}
"""LDLᵀ factorisation of a displacement-sized matrix, which may be indefinite."""

CONDENSED_CG: Options = {
    "ksp_type": "cg",
    # What Newton's method sees; the preconditioned norm may be far from it.
    "ksp_norm_type": "unpreconditioned",
    "pc_type": "gamg",
    # Rigid-body modes need the rotations smoothed too.
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_threshold": 0.01,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "jacobi",
    "mg_levels_ksp_max_it": 2,
    # Ten Krylov iterations see less than the largest eigenvalue where materials differ by 1e6, and
    # beyond 1.1 of what they see, PETSc's default, the preconditioner would be indefinite.
    "mg_levels_ksp_chebyshev_esteig": "0,0.1,0,1.3",
    "mg_coarse_sub_pc_type": "lu",
}
"""Conjugate gradients with algebraic multigrid on a displacement-sized matrix."""

UNSYMMETRIC: Mapping[str, Options] = {
    "preonly": {"pc_type": "lu"},
    "cg": {"ksp_type": "gmres", "ksp_gmres_restart": 60, "ksp_pc_side": "right"},
}
"""What takes the place of LDLᵀ and of CG where the matrix is not symmetric."""

DIRECT_UP_TO = {1: 100_000, 2: 100_000, 3: 5_000}
"""Displacement degrees of freedom up to which a condensed system is factorised, by dimension."""

SCHUR_DIRECT_UP_TO = 30_000
"""Displacement degrees of freedom up to which a full Schur factorisation has MUMPS for K."""

FACTORISE_UP_TO = 300_000
"""Displacement degrees of freedom up to which LDLᵀ replaces CG where CG fails."""

FACTORS_COST = (50, 300)
"""CG takes at least so many iterations, or one for so many degrees of freedom, before it fails:
somewhat more than factors cost. Without factors to replace it, it takes `MOST_CG`."""

MOST_CG = 2000
"""Where stiffness is very large beside inertia it may take more than a thousand."""

PATIENCE = 8
"""Newton iterations by factors before CG is tried again; twice as many when it fails again."""

KEEP_WHILE = 1.5
"""A preconditioner is kept while CG takes at most this many times the iterations of a new one."""

MOST_FULL_STEPS = 50
"""Iterations after which full steps count as diverging."""

DIVERGING = 100.0
"""Growth of the residual past that of the first iteration that tells full steps diverge."""

LONG = 60
"""Iterations of a step after which the next does without a search on the residual."""

FIRST_PART, SMALLEST_PART = 1 / 8, 1 / 256
"""Of the residual at the start, what a continuation lets in at first, and the least of it."""

WORTH_A_PART = 1 / 16
"""The least of it where there is an energy to go down on."""

MOST_OF_A_PART, EASY = 7, 3
"""Newton iterations for a part; and as many as let the next be twice as large."""

CLOSE = 0.1
"""Of a part, the residual that will do before the next one."""

NEAR_ROUND_OFF = 100.0
"""A residual that stagnates below this multiple of the estimated rounding error has converged."""

SETTLED = 1e-4
"""Of the body's size, a step below which a body whose forces rounding error hides has come to rest:
an exact Newton step more would be about the square of that."""

LAST_STEP = 1e-3
"""Of the largest step before it, the same: what stiff parts hide is then no part of the motion."""

TREMBLE, PART_OF_MOTION = 1e-6, 1e-2
"""Of the body's size, and of the largest step before, what a step that is no longer shorter than
the one before may be: rounding error is what moves the body."""

FALLEN = 1e-3
"""How far below its largest value it must be for that where a line search may cut steps."""

ARMIJO = 1e-4
"""What a step must bring, as a part of what the slope of the energy promises."""

SHORTEST = 1e-6
"""Shortest part of a step down the energy that is tried."""

ON_THE_WAY = (4, 16, 64)
"""Steps from the start of a solve in which cell-local fields are made to follow, where at once they
do not: so many, or else so many."""

NOWHERE = 8
"""A search on the residual that does not halve it in so many iterations leads nowhere."""

DOWN, UPHILL = 12, 5
"""Iterations down the energy before full steps are tried again; the most of those."""

LONGEST = 64.0
"""Most times that a step of a projected tangent is taken where that goes further down."""

FARTHEST = 100.0
"""Most that a step down the energy may move a point, in sizes of the body."""

ROUNDING = 1e-12
"""Of the energy, what rounding error may be where slopes are looked at too."""

FORCING_LIMITS = (1e-3, 1e-8)
"""Loosest and tightest relative tolerance of an iterative solve inside a Newton step."""

MODEST = 1e-2
"""Loosest relative tolerance on the condensed system itself, which sees the displacement only."""

RESOLVED = 1e5
"""Tightest relative tolerance on it, in units of the precision of a number."""

SOLVERS: Mapping[str, str] = {
    "direct": "LU of the whole block system by MUMPS",
    "fieldsplit": "block preconditioners by PETSc's field splits on the nested system; FGMRES",
    "condensed": "cell-local fields eliminated; LDLᵀ or CG with GAMG on the displacement (default)",
}
"""Solvers by name, with a one-line description."""


def condensed(unknowns: int, dimension: int, *, symmetric: bool) -> Options:
    """Options of `solver="condensed"` by the number of unknowns of the displacement."""
    inner = (
        CONDENSED_DIRECT if unknowns <= DIRECT_UP_TO[dimension] else conjugate_gradients(unknowns)
    )
    if not symmetric:
        inner = {**inner, **UNSYMMETRIC[str(inner["ksp_type"])]}
    return {**CONDENSED, **{f"condensed_{key}": value for key, value in inner.items()}}


def conjugate_gradients(unknowns: int) -> Options:
    """Options of conjugate gradients by the number of unknowns of the displacement."""
    least, part = FACTORS_COST
    most = max(least, unknowns // part) if unknowns <= FACTORISE_UP_TO else MOST_CG
    return {**CONDENSED_CG, "ksp_max_it": most}


class OptionSet:
    """Options under a prefix, in PETSc's database for as long as their owner lives."""

    _prefixes: ClassVar[weakref.WeakValueDictionary[str, OptionSet]] = weakref.WeakValueDictionary()

    def __init__(self, prefix: str, given: Options) -> None:
        """Put in the user's options, where there are none of the command line.

        Args:
            prefix: Ends in an underscore.
            given: The user's options.

        Raises:
            ValueError: Another owner that is alive has that prefix.
        """
        if prefix in self._prefixes:
            raise ValueError(f"the options prefix {prefix!r} belongs to another problem")
        self._prefixes[prefix] = self
        self.prefix = prefix
        self._placed: set[str] = set()
        # Of the command line's and the user's options those still to be read.
        self._unread = {*self._present(), *given}
        weakref.finalize(self, _remove, prefix, self._placed)
        self.put(given)

    def put(self, options: Options) -> None:
        """Enter options where there are none yet."""
        database, present = PETSc.Options(self.prefix), self._present()
        for key, value in options.items():
            if key not in present:
                database[key] = value
                self._placed.add(key)

    def flag(self, name: str) -> bool:
        """The value of a switch, off where it is not there."""
        return bool(PETSc.Options(self.prefix).getBool(name, False))

    def warn_of_unread(self, comm: MPI.Comm) -> None:
        """Report the user's options that nothing has asked for, once."""
        used = PETSc.Options().used
        unread = [self.prefix + key for key in self._unread if not used(self.prefix + key)]
        self._unread.clear()
        if unread and comm.rank == 0:
            logger.warning("options that nothing has used: %s", ", ".join(sorted(unread)))

    def _present(self) -> set[str]:
        """Names of the options there are, without the prefix."""
        # PETSc counts an option that it is asked for as used; this way it is not asked.
        every = PETSc.Options().getAll()
        return {k.removeprefix(self.prefix) for k in every if k.startswith(self.prefix)}


def _remove(prefix: str, keys: set[str]) -> None:
    for key in keys:
        PETSc.Options(prefix).delValue(key)
