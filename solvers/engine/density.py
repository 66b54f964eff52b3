"""From an energy to densities at a point: functions of a few numbers that are known there.

At a point an energy density is a function w(y; data) of values and gradients of the fields, of
functions of them that UFL cannot see through (`forms.CellData`, such as the polar rotation), and of
data: other coefficients, coordinates, constants. Here an energy is taken apart into such densities,
with coefficients of their own in place of all these, and the rest, which DOLFINx assembles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
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
    Constant,
    Derivative,
    Division,
    Product,
    Sum,
)
from ufl.core.expr import Expr

from forms import CellData
from solvers.engine.slots import NotPointwise, PointFunction, Slot, Slots, coefficients
from solvers.layout import is_local

Ints = npt.NDArray[np.int32]


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
    slots = Slots(fields)
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
