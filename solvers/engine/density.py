"""From an energy to densities at a point: functions of a few numbers that are known there.

At a point an energy density is a function w(y; data) of values and gradients of the fields, of
functions of them that UFL cannot see through (`forms.CellData`, such as the polar rotation), and of
data: other coefficients, coordinates, constants. Here an energy is taken apart into such densities,
with coefficients of their own in place of all these, and the rest, which DOLFINx assembles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from math import prod
from operator import add
from typing import Any

from mpi4py import MPI

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.algorithms import estimate_total_polynomial_degree, expand_derivatives
from ufl.algorithms.analysis import extract_type
from ufl.classes import (
    Coefficient,
    ComponentTensor,
    Constant,
    Derivative,
    Division,
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

from forms import CellData, CellFunction, Intermediate
from solvers.layout import is_local

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

    def components(self, e: Expr) -> list[Expr]:
        """The numbers of an expression of this slot's shape, in the order of their numbering."""
        every = np.ndindex(*self.shape)
        return [e[i] if i else e for i in every if not self.symmetric or i[0] >= i[1]]


@dataclass(eq=False)
class PointFunction(Slot):
    """The value of a function that UFL cannot see through, or of a part of the density.

    Attributes:
        source: The `CellData` that stand for it, None for a part of the density.
        argument: What it is a function of, or this part, in slots.
        unit: The slot whose change is that of the argument, if there is one.
        code: Its C source, None where it is the argument itself.
        stem: What the names of its C functions begin with.
        frozen: Whether its derivative counts as zero.
        rank: That of its derivative.
        kept: How many numbers its C functions keep of a point.
        parameters: Numbers that they are given.
    """

    argument: Expr = field(kw_only=True)
    unit: Slot | None = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        data = self.source if isinstance(self.source, CellData) else None
        self.code = data.code if data else None
        self.stem = self.code.stem if self.code else ""
        self.frozen = data is not None and data.code is None
        self.rank = data.rank if data else self.size
        self.kept = data.kept if data else 0
        self.parameters = data.parameters if data else ()


@dataclass
class Density:
    """A part of an energy, to be integrated with one rule over some cells.

    Attributes:
        expression: The density, in the coefficients of slots.
        degree: Of the rule of integration; 0 for a single point.
        cells: The cells of this rank that it is integrated over.
        shared: Slots of fields that have degrees of freedom in common with other cells.
        cellwise: Slots of fields that are polynomials on a cell.
        local: Slots of fields with a value of their own at each point.
        functions: Values of functions, each of slots before it.
        data: Slots without a derivative.
        constants: Constants, and what stands for each in the expression.
    """

    expression: Expr
    degree: int
    cells: Ints
    shared: list[Slot]
    cellwise: list[Slot]
    local: list[Slot]
    functions: list[PointFunction]
    data: list[Slot]
    constants: dict[fem.Constant, Constant]

    @property
    def arguments(self) -> list[Slot]:
        """Values and gradients of fields that the points of a cell have in common."""
        return self.shared + self.cellwise

    @property
    def unknowns(self) -> list[Slot]:
        """The slots that the density is differentiated by, in the order of their numbering."""
        return [*self.arguments, *self.local, *self.functions]

    @property
    def points(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Points and weights of the rule on the reference cell, as DOLFINx has them."""
        space = self.unknowns[0].source.function_space
        return quadrature(space, self.degree)


def quadrature(
    V: fem.FunctionSpace, degree: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Points and weights of a rule on the reference cell of a space."""
    points, weights = basix.make_quadrature(V.element.basix_element.cell_type, degree)
    return np.asarray(points), np.asarray(weights)


def take_apart(energy: ufl.Form, fields: Sequence[fem.Function]) -> tuple[list[Density], ufl.Form]:
    """Split an energy into densities at points, and the rest, in continuous fields' values alone.

    Args:
        energy: A functional of the fields.
        fields: The displacement first.

    Returns:
        The densities, and a form, which may be empty.

    Raises:
        NotPointwise: The energy is no function of numbers known at a point.
    """
    local = {f for f in fields if is_local(f)}
    rest: list[ufl.Integral] = []
    # By the measure without its subdomain, then by subdomain.
    groups: dict[tuple[Any, ...], dict[int | str, list[tuple[ufl.Integral, Expr]]]] = {}
    for integral in energy.integrals():
        if integral.integral_type() != "cell":
            beside = local.intersection(coefficients(integral.integrand()))
            if beside:
                kind = integral.integral_type().replace("_", " ")
                raise NotPointwise(f"{min(f.name for f in beside)} is in an {kind} integral")
            rest.append(integral)
            continue
        for term, pointwise in _terms(integral.integrand(), fields):
            if not pointwise:
                rest.append(integral.reconstruct(integrand=term))
                continue
            metadata = tuple(sorted(integral.metadata().items()))
            ids = integral.subdomain_id()
            by_id = groups.setdefault((metadata, id(integral.subdomain_data())), {})
            for number in ids if isinstance(ids, tuple) else (ids,):
                by_id.setdefault(number, []).append((integral, term))
    densities = [d for by_id in groups.values() for d in _by_subdomain(by_id, fields, local)]
    msh = fields[0].function_space.mesh
    # Not what no rank has a cell of, such as the rest beside subdomains that are all there is.
    densities = [d for d in densities if d.unknowns and msh.comm.allreduce(len(d.cells))]
    topology = msh.topology
    for f in sorted(local, key=lambda f: f.name):
        cells = [d.cells for d in densities if any(s.source is f for s in d.unknowns)]
        times = np.bincount(np.concatenate([[], *cells]).astype(np.int32), minlength=1)
        everywhere = (
            len(times) >= topology.index_map(topology.dim).size_local and (times == 1).all()
        )
        if not msh.comm.allreduce(everywhere, MPI.LAND):
            raise NotPointwise(f"{f.name} is integrated with several rules, or not on all cells")
    return densities, ufl.Form(rest)


def _terms(e: Expr, fields: Sequence[fem.Function]) -> Iterator[tuple[Expr, bool]]:
    """The terms of a sum, and whether each is for a density: what is no field's value alone.

    Products and quotients of sums are multiplied out where a part of them is for DOLFINx.
    """
    value, other = _contents(e, fields)
    if isinstance(e, Sum):
        for operand in e.ufl_operands:
            yield from _terms(operand, fields)
    elif value and other and isinstance(e, Product | Division):
        a, b = e.ufl_operands
        for first, _ in _terms(a, fields):
            if isinstance(e, Division):
                yield first / b, _is_pointwise(first / b, fields)
                continue
            for second, _ in _terms(b, fields):
                yield first * second, _is_pointwise(first * second, fields)
    else:
        yield e, _is_pointwise(e, fields)


def _is_pointwise(e: Expr, fields: Sequence[fem.Function]) -> bool:
    value, other = _contents(e, fields)
    return other or not value


def _contents(e: Expr, fields: Sequence[fem.Function]) -> tuple[bool, bool]:
    """Whether there are values of shared fields, and whether there is more of fields."""
    value = other = False
    nodes, seen = [e], set()
    while nodes:
        node = nodes.pop()
        if node in seen:
            continue
        seen.add(node)
        if isinstance(node, Coefficient):
            shared = node in fields and not is_local(node)
            value |= shared
            other |= isinstance(node, CellData) or (node in fields and not shared)
        elif isinstance(node, Derivative):
            other |= not extract_type(node, Coefficient).isdisjoint(fields)
        else:
            nodes += node.ufl_operands
    return value, other


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


def _by_subdomain(
    by_id: dict[int | str, list[tuple[ufl.Integral, Expr]]],
    fields: Sequence[fem.Function],
    local: set[fem.Function],
) -> Iterator[Density]:
    """The densities of each subdomain, of what is integrated everywhere in all of them."""
    topology = fields[0].function_space.mesh.topology
    left = np.arange(topology.index_map(topology.dim).size_local, dtype=np.int32)
    everywhere = by_id.pop("everywhere", [])
    for number, terms in by_id.items():
        data = terms[0][0].subdomain_data()
        cells = data.find(number) if hasattr(data, "find") else dict(data)[number]
        within = np.intersect1d(cells, left).astype(np.int32)
        left = np.setdiff1d(left, within).astype(np.int32)
        yield _density([*terms, *everywhere], within, fields, local)
    if everywhere:
        yield _density(everywhere, left, fields, local)


def _density(
    terms: Sequence[tuple[ufl.Integral, Expr]],
    cells: Ints,
    fields: Sequence[fem.Function],
    local: set[fem.Function],
) -> Density:
    metadata = dict(terms[0][0].metadata())
    degree = metadata.pop("quadrature_degree", None)
    if metadata:
        raise NotPointwise(f"a measure has the metadata {', '.join(metadata)}")
    whole = reduce(add, (term for _, term in terms))
    slots = _Slots(fields)
    expression = slots.of(whole)
    if degree is None:
        estimated = (
            0 if slots.constant else estimate_total_polynomial_degree(expand_derivatives(whole))
        )
        degree = estimated
    points = len(quadrature(fields[0].function_space, int(degree))[1])

    def at_points(s: Slot) -> bool:
        return (
            s.source in local
            and s.source.function_space.dofmap.list.shape[1] == points
            and (points == 1 or s.source.ufl_element().has_custom_quadrature)
        )

    known = list(slots.found.values())
    order = {f: k for k, f in enumerate(fields)}
    unknowns = sorted(
        (s for s in known if s.source in order), key=lambda s: (order[s.source], s.gradient)
    )
    return Density(
        expression,
        int(degree),
        cells,
        shared=[s for s in unknowns if s.source not in local],
        cellwise=[s for s in unknowns if s.source in local and not at_points(s)],
        local=[s for s in unknowns if at_points(s)],
        functions=[s for s in known if isinstance(s, PointFunction)],
        data=[s for s in known if s.source not in order and not isinstance(s, PointFunction)],
        constants=slots.constants,
    )


class _Slots:
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
                return self._function(label.data)
            if isinstance(label, Intermediate) and not self._fields.isdisjoint(
                coefficients(operand)
            ):
                argument = self.of(operand)
                symmetric = _is_symmetric(operand)
                part = PointFunction(None, e.ufl_shape, symmetric, argument=argument, unit=None)
                return self.found.setdefault((argument, False), part).coefficient
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

    def _moves(self, data: CellData) -> bool:
        """Whether data depend on the fields."""
        return not self._fields.isdisjoint(coefficients(data.argument))

    def _function(self, data: CellData) -> Expr:
        argument, symmetric = self.of(data.argument), data.code is not None and data.symmetric
        return self._slot(
            PointFunction(
                data,
                data.argument.ufl_shape,
                symmetric,
                argument=argument,
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
            return self._function(f)
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
