"""Default PETSc options. A user's own options, then the PETSc command line, override them."""

from __future__ import annotations

from collections.abc import Mapping

Options = Mapping[str, str | int | float | bool | None]

NEWTON: Options = {
    # Full steps; `MixedProblem` puts PETSc's "l2" search in their place where they diverge.
    "snes_linesearch_type": "basic",
    # Relative to the first residual of the solve; one quadratic step below what users look at.
    "snes_rtol": 1e-10,
    # Residuals may grow a lot before they fall: S follows u with a delay of one iteration.
    "snes_divergence_tolerance": 1e100,
    # A small step is no sign of convergence.
    "snes_stol": 0.0,
    "snes_max_it": 50,
}
"""Newton's method on several fields."""

PROJECTED: Options = {
    **NEWTON,
    # The tangent gives a direction of descent; Armijo's condition on the energy.
    "snes_linesearch_type": "bt",
    "snes_linesearch_order": 1,
    "snes_max_it": 200,
}
"""Projected Newton's method on the displacement alone."""

BACKTRACKING: Options = {
    **NEWTON,
    # Cubic backtracking on the residual norm, PETSc's default and the usual choice in DOLFINx.
    "snes_linesearch_type": "bt",
    "snes_max_it": 200,
}
"""Newton's method on the displacement alone, which does not converge with full steps."""

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
}
"""LDLᵀ factorisation of a displacement-sized matrix, which may be indefinite."""

CONDENSED_CG: Options = {
    "ksp_type": "cg",
    "ksp_max_it": 500,
    # What Newton's method sees; the preconditioned norm may be far from it.
    "ksp_norm_type": "unpreconditioned",
    "pc_type": "gamg",
    # Rigid-body modes need the rotations smoothed too.
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_threshold": 0.01,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "jacobi",
    "mg_levels_ksp_max_it": 2,
    "mg_coarse_sub_pc_type": "lu",
}
"""Conjugate gradients with algebraic multigrid on a displacement-sized matrix."""

DIRECT_UP_TO = 30_000
"""Displacement degrees of freedom up to which a condensed system is factorised."""

FACTORISE_UP_TO = 300_000
"""Displacement degrees of freedom up to which LDLᵀ replaces CG where CG fails."""

KEEP_WHILE = 1.5
"""A preconditioner is kept while CG takes at most this many times the iterations of a new one."""

DIVERGING = 100.0
"""Growth of the residual past that of the first iteration that tells full steps diverge."""

NEAR_ROUND_OFF = 100.0
"""A residual that stagnates below this multiple of the estimated rounding error has converged."""

FALLEN = 1e-3
"""How far below its largest value it must be for that where a line search may cut steps."""

ENERGY_RESOLVED = 1e-9
"""Relative change of the energy below which a line search on it sees rounding error."""

FORCING_LIMITS = (1e-3, 1e-8)
"""Loosest and tightest relative tolerance of an iterative solve inside a Newton step."""

MODEST = 1e-2
"""Loosest relative tolerance on the condensed system itself, which sees the displacement only."""

SOLVERS: Mapping[str, str] = {
    "direct": "LU of the whole block system by MUMPS",
    "fieldsplit": "block preconditioners by PETSc's field splits on the nested system; FGMRES",
    "condensed": "cell-local fields eliminated; LDLᵀ or CG with GAMG on the displacement (default)",
}
"""Solvers by name, with a one-line description."""
