"""Default PETSc options. A user's own options, then the PETSc command line, override them."""

from __future__ import annotations

from collections.abc import Mapping

Options = Mapping[str, str | int | float | bool | None]

NEWTON: Options = {
    # Full steps: exact mixed Newton needs no line search where it converges at all.
    "snes_linesearch_type": "basic",
    # Relative to the first residual of the solve; one quadratic step below what users look at.
    "snes_rtol": 1e-10,
    # A small step is no sign of convergence.
    "snes_stol": 0.0,
    "snes_max_it": 50,
}
"""Newton's method on several fields."""

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
    # The saddle point has zeros on the diagonal; pivoting fills in more than MUMPS foresees.
    "mat_mumps_icntl_14": 60,
}
"""LU factorisation of the whole block system."""

SOLVERS: Mapping[str, tuple[str, Options]] = {
    "direct": ("LU of the whole block system by MUMPS", DIRECT),
}
"""Linear solvers by name: a one-line description and the default options."""
