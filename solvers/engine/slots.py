"""Numbers known at a point: what stands for fields, functions of them and data in a density."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.algorithms import expand_derivatives
from ufl.algorithms.analysis import extract_type
from ufl.classes import (
    Coefficient,
    ComponentTensor,
    Constant,
    Derivative,
    GeometricQuantity,
    Grad,
    Indexed,
    Product,
    SpatialCoordinate,
    Sum,
    Sym,
    Variable,
)
from ufl.core.expr import Expr

from forms import CellData, CellFunction, Intermediate, Linearised

Ints = npt.NDArray[np.int32]

POINT = ufl.Mesh(basix.ufl.element("P", "interval", 1, shape=(1,)))
"""A cell that stands for a point: FFCx integrates over it with one point of weight 1."""


class NotPointwise(ValueError):
    """An energy that is no function of numbers known at a point; the message says why."""


@dataclass(eq=False)
class Slot:
    """Numbers known at a point, and the coefficient that stands for them in a density.

    Attributes:
        source: The field, coefficient or `CellData` that they are of; None for coordinates.
        shape: Shape of the value.
        symmetric: Whether it is a symmetric tensor, of which the lower triangle counts.
        gradient: Whether it is the source's gradient.
        coefficient: What stands for it, on `POINT`.
    """

    source: Any  # fem.Function | None
    shape: tuple[int, ...]
    symmetric: bool = False
    gradient: bool = False
    coefficient: Coefficient = field(init=False)

    def __post_init__(self) -> None:
        self.coefficient = Coefficient(ufl.FunctionSpace(POINT, self.element))

    @property
    def element(self) -> Any:
        """The element of these numbers, with one degree of freedom for each."""
        symmetry = self.symmetric or None
        return basix.ufl.element("DG", "interval", 0, shape=self.shape, symmetry=symmetry)

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return int(self.element.dim)


@dataclass(eq=False)
class PointFunction(Slot):
    """The value of a function that UFL cannot see through, or of a part of the density.

    Attributes:
        source: The `CellData` that stand for it, None for a part of the density.
        argument: What it is a function of, or this part, in slots.
        symmetric_argument: Whether that is a symmetric tensor.
        unit: The slot whose change is that of the argument, if there is one.
        linear: Whether its second derivative counts as zero.
        code: Its C source, None where it is the argument itself.
        stem: What the names of its C functions begin with.
        entries: The numbers of the argument.
        frozen: Whether its derivative counts as zero.
        rank: That of its derivative.
        kept: How many numbers its C functions keep of a point.
        parameters: Numbers that they are given.
    """

    argument: Expr = field(kw_only=True)
    symmetric_argument: bool = field(kw_only=True)
    unit: Slot | None = field(kw_only=True)
    linear: bool = field(kw_only=True, default=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        data = self.source if isinstance(self.source, CellData) else None
        self.code = data.code if data else None
        self.stem = data.stem or data.code.stem if data and data.code else ""
        self.frozen = data is not None and data.code is None
        self.rank = data.rank if data else self.size
        self.kept = data.kept if data else 0
        self.parameters = data.parameters if data else ()
        self.entries = _components(self.argument, self.symmetric_argument)


def _components(e: Expr, symmetric: bool) -> list[Expr]:
    """The numbers of an expression in the order of their numbering, of a tensor by rows."""
    every = np.ndindex(*e.ufl_shape)
    return [e[i] if i else e for i in every if not symmetric or i[0] >= i[1]]


def coefficients(e: Expr) -> list[fem.Function]:
    """Return the coefficients of an expression, and of the arguments of its per-cell data."""
    found = list(extract_type(e, Coefficient))
    for c in found:  # which grows
        if isinstance(c, CellData):
            found += [f for f in coefficients(c.argument) if f not in found]
    return found


def _is_symmetric(e: Any) -> bool:
    """Whether an expression is known to be a symmetric tensor."""
    if isinstance(e, fem.Function) and len(e.ufl_shape) == 2:
        return bool(e.function_space.dofmap.index_map_bs < prod(e.ufl_shape))
    if isinstance(e, ComponentTensor):  # a scalar times a tensor
        scaled, indices = e.ufl_operands
        factors: Sequence[Expr] = scaled.ufl_operands if isinstance(scaled, Product) else ()
        return any(
            isinstance(f, Indexed)
            and f.ufl_operands[1] == indices
            and _is_symmetric(f.ufl_operands[0])
            for f in factors
        )
    return isinstance(e, Sym)


def _plain(e: Expr) -> Expr:
    """An expression without a mark of its own."""
    return e.ufl_operands[0] if isinstance(e, Variable) else e


class Slots:
    """Puts coefficients of slots in the place of what is known at a point.

    Attributes:
        found: The slots, those of functions after what they are functions of.
        constants: Constants, and what stands for them.
        constant: Whether all of it is constant on each cell.
    """

    def __init__(self, fields: Sequence[fem.Function]) -> None:
        self._fields = set(fields)
        self._cache: dict[Expr, Expr] = {}
        self.found: dict[tuple[object, bool], Slot] = {}
        self.constants: dict[fem.Constant, Constant] = {}
        self.constant = True

    def of(self, e: Expr) -> Expr:
        """Return an expression in coefficients of slots."""
        if e not in self._cache:
            self._cache[e] = self._of(e)
        return self._cache[e]

    def _of(self, e: Any) -> Expr:
        if isinstance(e, Variable):
            operand, label = e.ufl_operands
            if isinstance(label, CellFunction) and self._moves(label.data):
                return self._function(label.data, operand.ufl_shape)
            if isinstance(label, Intermediate | Linearised) and not self._fields.isdisjoint(
                coefficients(operand)
            ):
                if isinstance(label, Linearised):
                    return self._part(_plain(label.exact), linear=True)
                return self._part(operand, linear=False)
            return self.of(operand)
        if isinstance(e, Grad) and isinstance(e.ufl_operands[0], fem.Function):
            return self._value(e.ufl_operands[0], gradient=True)
        if isinstance(e, Derivative):
            expanded = expand_derivatives(e)
            if isinstance(expanded, Derivative):
                raise NotPointwise(f"it has the derivative {e}")
            return self.of(expanded)
        if isinstance(e, fem.Function):
            return self._value(e, gradient=False)
        if isinstance(e, fem.Constant):
            return self.constants.setdefault(e, Constant(POINT, e.ufl_shape))
        if isinstance(e, SpatialCoordinate):
            self.constant = False
            return self._slot(Slot(None, e.ufl_shape))
        if isinstance(e, GeometricQuantity):
            raise NotPointwise(f"it has the geometric quantity {e}")
        if e._ufl_is_terminal_:
            return e
        return e._ufl_expr_reconstruct_(*map(self.of, e.ufl_operands))

    def _part(self, e: Expr, *, linear: bool) -> Expr:
        argument, symmetric = self.of(e), _is_symmetric(e)
        part = PointFunction(
            None,
            e.ufl_shape,
            symmetric,
            argument=argument,
            symmetric_argument=symmetric,
            unit=None,
            linear=linear,
        )
        return self.found.setdefault((argument, linear), part).coefficient

    def _moves(self, data: CellData) -> bool:
        """Whether data depend on the fields."""
        return not self._fields.isdisjoint(coefficients(data.argument))

    def _function(self, data: CellData, shape: tuple[int, ...]) -> Expr:
        argument, symmetric = self.of(data.argument), data.code is not None and data.symmetric
        return self._slot(
            PointFunction(
                data,
                shape,
                symmetric and len(shape) == 2,
                argument=argument,
                symmetric_argument=symmetric,
                unit=self._unit(argument, symmetric),
            )
        )

    def _unit(self, argument: Expr, symmetric: bool) -> Slot | None:
        """The slot of which an argument is the sum with something that does not change."""
        unknowns: dict[Expr, Slot] = {
            s.coefficient: s
            for s in self.found.values()
            if isinstance(s, PointFunction) or s.source in self._fields
        }
        terms = argument.ufl_operands if isinstance(argument, Sum) else [argument]
        moving = [t for t in terms if unknowns.keys() & extract_type(t, Coefficient)]
        slot = unknowns.get(moving[0]) if len(moving) == 1 else None
        return slot if slot is not None and slot.symmetric == symmetric else None

    def _value(self, f: fem.Function, *, gradient: bool) -> Expr:
        if isinstance(f, CellData) and self._moves(f):
            if f.code is not None or gradient:
                raise NotPointwise(f"it has a derivative of the function of {f.argument}")
            return self._function(f, f.argument.ufl_shape)
        element = f.ufl_element()
        if gradient and element.has_custom_quadrature:
            raise NotPointwise(f"it has the gradient of {f.name}, which is known at points only")
        self.constant &= element.embedded_superdegree <= int(gradient)
        if gradient:
            return self._slot(
                Slot(f, (*f.ufl_shape, f.function_space.mesh.geometry.dim), False, True)
            )
        return self._slot(Slot(f, f.ufl_shape, _is_symmetric(f)))

    def _slot(self, slot: Slot) -> Expr:
        return self.found.setdefault((slot.source, slot.gradient), slot).coefficient
