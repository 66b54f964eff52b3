"""`mixed-fem study refinement`: orders in the mesh size, by the method of manufactured solutions.

A body is twisted and stretched, u = Q(θ)(X - c)(1 + X₁/10) + c - X with θ = 0.9 t X_last, at rest
or in time steps. The load is what makes u exact, taken in the weak form: ∫ P(F_exact) : ∇v, and in
motion ∫ ρ/h² (u(t + h) - 2 u(t) + u(t - h)) · v, so that nothing but the error in space is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from ufl.core.expr import Expr

from demos.studies.records import Column, Record, fitted_orders, groups, in_columns, select
from demos.studies.study import Parameters, Study
from forms import (
    FORMULATIONS,
    BackwardEuler,
    StableNeoHookean,
    deformation_gradient,
    measure,
    quadrature_degree,
)
from forms.expressions import at_points
from meshes import CELLS, box
from solvers import SOLVERS, ConvergenceError, MixedProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

RHO, H, STEPS = 2.0, 0.2, 3  # [kg/m³], [s], and steps in motion
PSI = StableNeoHookean(E=10.0, nu=0.3)
DEGREE = 6  # of quadrature, and more with the degree of the displacement

ORDERS = {"u_L2": 1, "u_H1": 0, "S_L2": 0, "Lam_L2": 0}
"""Expected orders of the errors, less the degree of the displacement."""

TITLES = {"u_L2": "u in L2", "u_H1": "u in H1", "S_L2": "S in L2", "Lam_L2": "Λ in L2"}

LEVELS = {2: (4, 8, 16, 32), 3: (2, 4, 8, 16)}
QUICK_LEVELS = {2: (4, 8, 16, 32), 3: (2, 4, 8)}
INEXACT_LEVELS = {2: (2, 4, 8, 16), 3: (2, 4, 8)}

TAYLOR_HOOD, TAYLOR_HOOD_LEVELS = "taylor-hood", (2, 4, 8, 16)
"""In 2D, of P2 displacements by degree 1, by the direct solver: the condensed one moves the edge
before the rest of the body, which turns cells of the finest mesh over."""

ELEMENTS = tuple((d, cell, degree) for d in (2, 3) for cell in CELLS[d] for degree in (1, 2, 3))
"""Dimension, cell and degree of the displacement, of the static series of `symmetric`."""

ELEMENT_LEVELS = {2: (2, 4, 8, 16), 3: (1, 2, 4, 8)}
LARGEST = ("hexahedron", 3)  # whose finest level would need 20 GB


def grid(quick: bool) -> list[Parameters]:
    """Every formulation, dimension and motion; solvers on one of them, as they do not matter."""
    cases: list[Parameters] = []
    for formulation in ("symmetric", "seed", "displacement") if quick else FORMULATIONS:
        given = QUICK_LEVELS if quick else LEVELS
        if not FORMULATIONS[formulation].exact:
            given = INEXACT_LEVELS
        if formulation == TAYLOR_HOOD:
            cases += [
                case(formulation, 2, motion, "direct", n)
                for motion in ("static", "dynamic")
                for n in TAYLOR_HOOD_LEVELS
            ]
            continue
        for d, levels in given.items():
            if quick and d == 3 and formulation != "symmetric":
                continue
            for motion in ("static", "dynamic"):
                cases += [case(formulation, d, motion, "condensed", n) for n in levels]
    for solver in SOLVERS:
        if solver != "condensed":
            cases += [case("symmetric", 2, "static", solver, n) for n in LEVELS[2]]
    for d, cell, degree in ELEMENTS:
        # P1 on simplices is among the formulations.
        if not (quick and d == 3) and (cell, degree) != (CELLS[d][0], 1):
            levels = ELEMENT_LEVELS[d][:-1] if (cell, degree) == LARGEST else ELEMENT_LEVELS[d]
            cases += [
                case("symmetric", d, "static", "condensed", n, cell=cell, degree=degree)
                for n in levels
            ]
    return cases


def case(
    formulation: str,
    d: int,
    motion: str,
    solver: str,
    n: int,
    *,
    cell: str | None = None,
    degree: int = 1,
) -> Parameters:
    """The parameters of a case with n cells along each edge of the unit cube."""
    return {
        **{"formulation": formulation, "dimension": d, "motion": motion},
        **{"solver": solver, "cell": cell or CELLS[d][0], "degree": degree, "cells": n},
    }


def _exact(X: Expr, t: Expr) -> Expr:
    """The manufactured displacement at time t."""
    d = len(X)
    center = ufl.as_vector([0.5] * d)
    angle = 0.9 * t * X[d - 1]
    Q = ufl.as_matrix(
        [
            [ufl.cos(angle) if i == j and i < 2 else float(i == j) for j in range(d)]
            for i in range(d)
        ]
    )
    turn = ufl.as_matrix(
        [[{(0, 1): -1.0, (1, 0): 1.0}.get((i, j), 0.0) for j in range(d)] for i in range(d)]
    )
    Q = Q + ufl.sin(angle) * turn
    return Q * (X - center) * (1 + 0.1 * t * X[1]) + center - X


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Solve on one mesh and measure the errors. Collective."""
    d, n = parameters["dimension"], parameters["cells"]
    form = FORMULATIONS[parameters["formulation"]]
    msh = box(comm, size=(1.0,) * d, cells=(n,) * d, cell=parameters["cell"]).mesh
    fields = form.fields(msh, parameters["degree"])
    u = fields[0]
    V = u.function_space
    X = ufl.SpatialCoordinate(msh)
    t: Any = fem.Constant(msh, 1.0)
    F = ufl.variable(ufl.Identity(d) + ufl.grad(_exact(X, t)))
    P = ufl.diff(PSI(F), F)  # this Ψ(S) depends on |S|² and det S, which are those of F
    dx = ufl.dx(metadata={"quadrature_degree": DEGREE + 2 * parameters["degree"] - 2})
    energy = form.density(*fields, PSI) * measure(u) - ufl.inner(P, ufl.grad(u)) * dx
    points = V.element.interpolation_points
    at_t, velocity = (
        fem.Expression(e, points) for e in (_exact(X, t), (_exact(X, t) - _exact(X, t - H)) / H)
    )
    dynamic = parameters["motion"] == "dynamic"
    steps = STEPS if dynamic else 1
    t.value = 1.0 - H * (steps if dynamic else 0)
    u.interpolate(at_t)
    scheme = BackwardEuler(u, H)
    if dynamic:
        scheme.v.interpolate(velocity)
    if (parameters["cell"], parameters["degree"]) == (CELLS[d][0], 1):
        # Both motions have the same forms, to be compiled once: at rest the density is 0.
        rho: Any = fem.Constant(msh, RHO if dynamic else 0.0)
        acceleration = (_exact(X, t) - 2 * _exact(X, t - H) + _exact(X, t - 2 * H)) / H**2
        energy += scheme.kinetic(rho) * ufl.dx - rho * ufl.inner(acceleration, u) * dx
    msh.topology.create_connectivity(d - 1, d)
    boundary = fem.Function(V)
    facets = exterior_facet_indices(msh.topology)
    bc = fem.dirichletbc(boundary, fem.locate_dofs_topological(V, d - 1, facets))
    # Where Newton's method is linear it takes its time.
    options = None if form.exact else {"snes_max_it": 1000}
    problem = MixedProblem(energy, fields, [bc], solver=parameters["solver"], options=options)
    iterations = []
    for _ in range(steps):
        if dynamic:
            t.value += H
        boundary.interpolate(at_t)
        try:
            iterations.append(problem.solve().iterations)
        except ConvergenceError as error:
            return {"failure": error.result.reason, "iterations": iterations}
        scheme.advance()
    problem.refresh()
    expressions = {
        "u": (u, _exact(X, t)),
        "F": (deformation_gradient(u), F),
        "S": (form.stretch(*fields), F),
        "Lam": (form.stress(*fields, PSI), P),
    }
    errors = _errors(u, expressions)
    return {
        "failure": "",
        "iterations": iterations,
        **{
            key: float(np.sqrt(comm.allreduce(value)))
            for key, value in (
                ("u_L2", errors["u"]),
                ("u_H1", errors["u"] + errors["F"]),
                ("S_L2", errors["S"]),
                ("Lam_L2", errors["Lam"]),
            )
        },
    }


def _errors(u: fem.Function[Any], pairs: dict[str, tuple[Expr, Expr]]) -> dict[str, float]:
    """Squared L2 norms over this rank's cells of the differences; S is that of the exact F.

    S and Λ are compared at the points at which they live.
    """
    V = u.function_space
    msh, own = V.mesh, quadrature_degree(V)
    d = msh.geometry.dim
    many = DEGREE + 2 * int(V.element.basix_element.degree) - 2
    rules = {
        degree: tuple(
            np.array(a, dtype=float) for a in basix.make_quadrature(msh.basix_cell(), degree)
        )
        for degree in {many, own or many}
    }
    cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)

    squares = {}
    for name, (computed, exact) in pairs.items():
        points, weights = rules[own or many if name in ("S", "Lam") else many]

        def at(expression: Expr, points: Array = points) -> Array:
            return np.array(at_points(expression, points).eval(msh, cells), dtype=float)

        shape = len(cells), len(points)
        size = np.abs(at(ufl.JacobianDeterminant(msh))).reshape(shape)
        if name == "S":
            S, F = (at(e).reshape(*shape, d, d) for e in (computed, exact))
            difference = S - _stretch(F)
        else:
            difference = at(computed - exact)
        density = np.sum(difference.reshape(*shape, -1) ** 2, axis=2) * size
        squares[name] = float(np.sum(density @ weights))
    return squares


def _stretch(F: Array) -> Array:
    """√(FᵀF), the right stretch of F with det F > 0."""
    values, vectors = np.linalg.eigh(np.swapaxes(F, -1, -2) @ F)
    S: Array = (vectors * np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return S


# What to show


def _series(records: Sequence[Record]) -> dict[tuple[Any, ...], list[Record]]:
    """Records of growing fineness by what else tells them apart."""
    return groups(records, "formulation", "dimension", "motion", "solver", "cell", "degree")


def expected(degree: int) -> dict[str, int]:
    """The orders of the errors with displacements of a degree."""
    return {name: degree + more for name, more in ORDERS.items()}


def orders(levels: Sequence[Record]) -> dict[str, float]:
    """The order of each error."""
    return fitted_orders(levels, lambda r: 1.0 / r["cells"], ORDERS)


COLUMNS: dict[str, Column] = {
    "formulation": "{formulation}",
    "motion": "{motion} {dimension}D",
    "solver": "{solver}",
    "element": "{cell} {degree}",
    "cells": "{cells}",
    **{f"{name}, order": f"{{{name}:.2e}} {{of_{name}:5.2f}}" for name in ORDERS},
}


def table(records: Sequence[Record]) -> list[str]:
    """The finest errors and the orders."""
    rows = []
    for levels in _series(records).values():
        order = {f"of_{name}": value for name, value in orders(levels).items()}
        done = select(levels, failure="")
        rows += [{**r, **order} for r in levels if r["failure"] or r is done[-1]]
    return [
        "",
        "Error on the finest mesh and its order over the finest three:",
        "",
        *in_columns(rows, COLUMNS, case=5),
    ]


def verdict(records: Sequence[Record]) -> list[str]:
    """Exact Newton methods that fail, and orders that are more than 0.1 below what is expected."""
    lines = []
    for key, levels in _series(records).items():
        name = ", ".join(map(str, key))
        if FORMULATIONS[key[0]].exact:
            lines += [f"{name}, {r['cells']} cells: {r['failure']}" for r in levels if r["failure"]]
        found = orders(levels)
        lines += [
            f"{name}: {error} has order {found[error]:.2f}, expected {order}"
            for error, order in expected(key[5] + (key[0] == TAYLOR_HOOD)).items()
            if not found[error] >= order - 0.1
        ]
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Errors of the first formulation over the mesh size: 2D and 3D, then element by element."""
    shown = {
        key: select(levels, failure="")
        for key, levels in _series(records).items()
        if (key[0], key[3]) == (records[0]["formulation"], records[0]["solver"])
    }
    dimensions = sorted({key[1] for key in shown})
    kinds = [cell for d in dimensions for cell in CELLS[d]]
    figure.set_size_inches(4.5 * (len(dimensions) + 1) + 1.5, 4.0)
    *plots, last = figure.subplots(1, len(dimensions) + 1)
    levels: dict[Axes, set[int]] = {plot: set() for plot in (*plots, last)}
    for (formulation, d, motion, _, cell, degree), done in shown.items():
        if not done:
            continue
        h = np.array([1.0 / r["cells"] for r in done])
        orders_of = expected(degree)
        if (cell, degree) == (CELLS[d][0], 1):
            plot = plots[dimensions.index(d)]
            levels[plot] |= {r["cells"] for r in done}
            style = {"ls": "-", "marker": "o", "ms": 4}
            if motion == "dynamic":  # on top of the others
                style = {"ls": "none", "marker": "s", "ms": 8, "mfc": "none"}
            for k, (name, order) in enumerate(orders_of.items()):
                values = [r[name] for r in done]
                label = f"{TITLES[name]}, {motion}"
                plot.loglog(h, values, color=f"C{k}", label=label, **style)
                plot.loglog(h, 0.7 * values[-1] * (h / h[-1]) ** order, "k:", lw=0.7)
            plot.set_title(f"{d}D, {formulation}, degree 1; dotted: orders expected", fontsize=9)
        if motion == "static":
            values = [r["u_L2"] for r in done]
            levels[last] |= {r["cells"] for r in done}
            style = {"color": f"C{kinds.index(cell)}", "marker": "osv^"[degree - 1], "ms": 4}
            last.loglog(h, values, label=f"{cell}, degree {degree}", **style)
            last.loglog(h, 0.7 * values[-1] * (h / h[-1]) ** orders_of["u_L2"], "k:", lw=0.7)
    last.set_title("u in L2, static, by element", fontsize=9)
    for plot, cells in levels.items():
        plot.set_xticks([1 / n for n in cells], [f"1/{n}" for n in cells])
        plot.minorticks_off()
        plot.set_xlabel("mesh size [m]")
        plot.grid(alpha=0.3)
        if plot.lines:
            plot.legend(fontsize=7)
    if last.lines:  # beside the plot, which it would fill
        last.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.02, 0.5))
    plots[0].set_ylabel("error")


REFINEMENT = Study(
    name="refinement",
    description="orders of u, S and Λ in the mesh size, by manufactured solutions",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
