"""UFL expressions at points of cells, compiled once for all that are alike."""

from __future__ import annotations

from typing import Any

import basix
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from ufl.core.expr import Expr
from ufl.corealg.map_dag import map_expr_dag
from ufl.corealg.multifunction import MultiFunction
from ufl.variable import Label, Variable

from forms.cell_data import refresh
from forms.points import quadrature_degree


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


class PointValues:
    """An expression at the points of the owned cells at which cell-local fields live.

    Attributes:
        weights: Of the points of a cell; their sum is the volume of the reference cell.
    """

    def __init__(self, expression: Expr, u: fem.Function[Any]) -> None:
        """Compile the expression.

        Args:
            expression: Of a displacement and other fields.
            u: The displacement.
        """
        self._mesh, self._expression = u.function_space.mesh, expression
        points, self.weights = (
            np.array(a, dtype=np.float64)
            for a in basix.make_quadrature(
                self._mesh.basix_cell(), quadrature_degree(u.function_space)
            )
        )
        self._compiled = at_points(expression, points)
        cells = self._mesh.topology.index_map(self._mesh.topology.dim).size_local
        self._cells = np.arange(cells, dtype=np.int32)

    def now(self) -> npt.NDArray[np.float64]:
        """Return the present values, shape (owned cells, points, *shape of the expression)."""
        refresh([self._expression])
        return np.asarray(self._compiled.eval(self._mesh, self._cells), dtype=np.float64)


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
