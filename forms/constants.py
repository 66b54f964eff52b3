"""Numbers that forms see as constants, so that a change of value compiles nothing anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx import fem, mesh
from ufl.core.expr import Expr


def as_constant(value: float | Sequence[float] | Expr, msh: mesh.Mesh) -> Expr:
    """Return a number or vector as a `fem.Constant`, and an expression as it is."""
    return value if isinstance(value, Expr) else fem.Constant(msh, np.array(value, dtype=float))
