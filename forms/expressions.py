"""UFL expressions at points of a cell, compiled once for all that are alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from ufl.core.expr import Expr
from ufl.corealg.map_dag import map_expr_dag
from ufl.corealg.multifunction import MultiFunction
from ufl.variable import Label, Variable


def at_points(expression: Expr, points: npt.NDArray[np.float64]) -> fem.Expression:
    """Compile an expression for its values at points of the reference cell.

    The variables by which it is differentiated get numbers in the order in which they come. UFL
    numbers all of a process, and DOLFINx would take the same expression for another one each time
    that it is written down, and compile it anew.

    Args:
        expression: Of fields, constants and the geometry of one mesh.
        points: Shape (points, dimension of the cell).
    """
    return fem.Expression(map_expr_dag(_Relabelled(), expression), points)


class _Relabelled(MultiFunction):
    """An expression with its variables numbered from 0."""

    expr = MultiFunction.reuse_if_untouched

    def __init__(self) -> None:
        super().__init__()
        self._numbers: dict[Label, int] = {}

    def variable(self, _: Variable, *operands: Any) -> Variable:
        return Variable(*operands)

    def label(self, label: Label) -> Label:
        return Label(self._numbers.setdefault(label, len(self._numbers)))
