"""Per-cell data that depend on the unknowns but that UFL does not differentiate."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh
from ufl.algorithms import extract_coefficients, strip_variables
from ufl.core.expr import Expr

from forms.points import common_degree, local_space


class CellData(fem.Function):
    """A coefficient computed point by point from an expression.

    The points are one a cell where the expression is constant on each cell, else the quadrature
    points of `forms.points`.

    UFL treats it as a constant, so an expression that uses it must carry its derivative in another
    way (see `forms.rotation`), or do without (see `frozen`). A solver finds every `CellData` among
    the coefficients of an energy and calls `refresh` before each evaluation of a residual or a
    Jacobian. A form or expression that is evaluated by itself is for its owner to `refresh`; what
    DOLFINx compiles keeps the numbers, not the object that recomputes them.
    """

    def __init__(
        self,
        expression: Expr,
        shape: tuple[int, ...],
        name: str,
        msh: mesh.Mesh | None = None,
    ) -> None:
        """Compile the expression (cached on disk afterwards) and compute the values.

        Args:
            expression: What the data are computed from.
            shape: Shape of the data on a cell.
            name: Name of the function.
            msh: The mesh, needed if no finite element function is in the expression.
        """
        expression = strip_variables(expression)
        coefficients = extract_coefficients(expression)
        if msh is None:
            msh = coefficients[0].function_space.mesh
        super().__init__(local_space(msh, common_degree(coefficients), shape), name=name)
        self._inner = [c for c in coefficients if isinstance(c, CellData)]
        points = self.function_space.element.interpolation_points
        self._expression = fem.Expression(expression, points)
        cells = msh.topology.index_map(msh.topology.dim)
        self._cells = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
        self.refresh()

    def refresh(self) -> None:
        """Recompute the values on all owned and ghost cells of this rank. Not collective."""
        for data in self._inner:
            data.refresh()
        values = self._expression.eval(self.function_space.mesh, self._cells)
        flat = np.asarray(values, dtype=np.float64).reshape(-1, *values.shape[2:])
        computed = self.compute(flat)
        dofs, size = self.function_space.dofmap.list, self.function_space.dofmap.bs
        self.x.array.reshape(-1, size)[dofs] = computed.reshape(*dofs.shape, size)

    @abstractmethod
    def compute(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the data of each point, given the expression's values.

        Args:
            values: Shape (points, *shape of the expression).

        Returns:
            Shape (points, ...) with as many components as the data have.
        """


class _Frozen(CellData):
    def compute(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return values


def frozen(expression: Expr, msh: mesh.Mesh | None = None) -> CellData:
    """Return the present value of an expression, the derivative of which counts as zero.

    In an energy it makes Newton's method lag the expression: residuals are those of the present
    value, but the Newton matrix does not know that it changes.

    Args:
        expression: Of any shape.
        msh: The mesh, needed if no finite element function is in the expression.
    """
    return _Frozen(expression, expression.ufl_shape, "frozen", msh)


def refresh(expressions: Iterable[Expr | ufl.Form]) -> None:
    """Recompute the per-cell data in expressions or forms. Not collective."""
    for expression in expressions:
        for coefficient in extract_coefficients(expression):
            if isinstance(coefficient, CellData):
                coefficient.refresh()
