"""Per-cell data that depend on the unknowns but that UFL does not differentiate."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh
from ufl.algorithms import expand_derivatives, extract_coefficients, strip_variables
from ufl.classes import Label, Variable
from ufl.core.expr import Expr

from forms.points import common_degree, local_space
from forms.spaces import zeros


class CellData(fem.Function):
    """A coefficient computed point by point from an expression.

    The points are one a cell where the expression is constant on each cell, else the quadrature
    points of `forms.points`.

    UFL treats it as a constant, so an expression that uses it must carry its derivative in another
    way (see `forms.rotation`), or do without (see `frozen`). A solver finds every `CellData` among
    the coefficients of an energy and calls `refresh` before each evaluation of a residual or a
    Jacobian, or computes them in compiled code of its own (`code`). A form or expression that is
    evaluated by itself is for its owner to `refresh`; what DOLFINx compiles keeps the numbers, not
    the object that recomputes them. So there is one set of data for an expression (`of`), which
    lives as long as the finite element functions in it.

    Attributes:
        argument: What the data are computed from.
        code: C source of the function of the argument that the data stand for, or None where that
            is the argument itself; `forms/code/polar.h` is an example.
        stem: What the names of its C functions begin with, that of the source if it is empty.
        symmetric: Whether the argument is a symmetric tensor, and the value if it is a tensor.
        rank: That of its derivative.
        kept: How many numbers the source keeps for derivatives.
        parameters: Numbers that it is given.
    """

    code: ClassVar[Path | None] = None
    stem: ClassVar[str] = ""
    symmetric: ClassVar[bool] = False
    rank: int = 0
    kept: int = 0
    parameters: tuple[float, ...] = (0.0,)

    def __init__(self, argument: Expr, shape: tuple[int, ...], name: str) -> None:
        """Make the coefficient, not a number before the first `refresh`.

        Args:
            argument: What the data are computed from.
            shape: Shape of the data at a point.
            name: Name of the function.
        """
        self.argument = argument
        coefficients = extract_coefficients(argument)
        domain: Any = ufl.domain.extract_unique_domain(argument)
        msh = mesh.Mesh(domain.ufl_cargo(), domain)
        V = local_space(msh, common_degree(coefficients), shape)
        super().__init__(V, zeros(V), name=name)
        self.x.array[:] = np.nan  # rather than numbers of no state
        self._inner = [c for c in coefficients if isinstance(c, CellData)]
        self._compiled: fem.Expression | None = None

    @classmethod
    def of(cls, argument: Expr, *args: Any) -> Self:
        """Return the data of an expression, the same object for the same expression.

        Args:
            argument: What the data are computed from.
            args: Further arguments of the class, hashable.
        """
        owners = extract_coefficients(argument)
        if not owners:
            return cls(argument, *args)
        known = vars(owners[0]).setdefault("_cell_data", {})
        key = cls, argument, args
        if key not in known:
            known[key] = cls(argument, *args)
        data: Self = known[key]
        return data

    def refresh(self) -> None:
        """Recompute the values on all owned and ghost cells of this rank. Not collective.

        The first time it compiles the expression, which is collective and cached on disk.
        """
        for data in self._inner:
            data.refresh()
        V = self.function_space
        if self._compiled is None:
            points = V.element.interpolation_points
            plain = strip_variables(expand_derivatives(self.argument))
            self._compiled = fem.Expression(plain, points)
            cells = V.mesh.topology.index_map(V.mesh.topology.dim)
            self._cells = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
        values = self._compiled.eval(V.mesh, self._cells)
        flat = np.asarray(values, dtype=np.float64).reshape(-1, *values.shape[2:])
        computed = self.compute(flat)
        dofs, size = V.dofmap.list, V.dofmap.bs
        self.x.array.reshape(-1, size)[dofs] = computed.reshape(*dofs.shape, size)

    @abstractmethod
    def compute(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the data of each point, given the argument's values.

        Args:
            values: Shape (points, *shape of the argument).

        Returns:
            Shape (points, ...) with as many components as the data have.
        """


class CellFunction(Label):
    """Marks the place in an expression where the function that `data` stand for is expanded."""

    def __init__(self, data: CellData) -> None:
        super().__init__()
        self.data = data


def marked(expansion: Expr, data: CellData) -> Variable:
    """Return an expansion around the present data, marked as the function they stand for.

    UFL differentiates the expansion. Who knows the function itself finds it by the mark.
    """
    return Variable(expansion, CellFunction(data))


class Intermediate(Label):
    """Marks a part of an expression that is worth a derivative of its own."""


def intermediate(expression: Expr) -> Expr:
    """Return the expression, marked as a part that is worth derivatives of its own.

    Its value is the same. Who differentiates an energy density may go by the chain rule over this
    part, which keeps the code for second derivatives short: that of Ψ(S(F)) has them of Ψ and those
    of S(F), not all of their products.

    Args:
        expression: Of any shape.
    """
    return Variable(expression, Intermediate())


class Linearised(Label):
    """Marks the linearisation of an expression about the present state."""

    def __init__(self, exact: Expr) -> None:
        super().__init__()
        self.exact = exact


def linearisation(tangent: Expr, exact: Expr) -> Variable:
    """Return an affine expression, marked as the linearisation of another one at present.

    UFL differentiates the tangent. Who knows the derivatives of the other may take the first of
    them, and zero for the second.

    Args:
        tangent: Has the value and the first derivative of `exact`, and a second one of zero.
        exact: Of the same shape.
    """
    return Variable(tangent, Linearised(exact))


class _Frozen(CellData):
    def __init__(self, argument: Expr) -> None:
        super().__init__(argument, argument.ufl_shape, "frozen")

    def compute(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return values


def frozen(expression: Expr) -> CellData:
    """Return the present value of an expression, the derivative of which counts as zero.

    In an energy it makes Newton's method lag the expression: residuals are those of the present
    value, but the Newton matrix does not know that it changes.

    Args:
        expression: Of any shape, on the mesh of one of its terms.
    """
    return _Frozen.of(expression)


def refresh(expressions: Iterable[Expr | ufl.Form]) -> None:
    """Recompute the per-cell data in expressions or forms. Collective the first time."""
    for expression in expressions:
        for coefficient in extract_coefficients(expression):
            if isinstance(coefficient, CellData):
                coefficient.refresh()
