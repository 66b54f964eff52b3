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

from demos.studies.study import Parameters, Record, Study
from forms import FORMULATIONS, BackwardEuler, StableNeoHookean, deformation_gradient
from meshes import box
from solvers import SOLVERS, ConvergenceError, MixedProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

RHO, H, STEPS = 2.0, 0.2, 3  # [kg/m³], [s], and steps in motion
PSI = StableNeoHookean(E=10.0, nu=0.3)
DEGREE = 6  # of quadrature

ORDERS = {"u_L2": 2, "u_H1": 1, "S_L2": 1, "Lam_L2": 1}
"""Expected orders of the errors for P1 displacements with cell-wise constant S and Λ."""

TITLES = {"u_L2": "u in L2", "u_H1": "u in H1", "S_L2": "S in L2", "Lam_L2": "Λ in L2"}

LEVELS = {2: (4, 8, 16, 32), 3: (2, 4, 8, 16)}
QUICK_LEVELS = {2: (4, 8, 16, 32), 3: (2, 4, 8)}
INEXACT_LEVELS = {2: (2, 4, 8, 16), 3: (2, 4, 8)}


def grid(quick: bool) -> list[Parameters]:
    """Every formulation, dimension and motion; solvers on one of them, as they do not matter."""
    cases: list[Parameters] = []
    for formulation in ("symmetric", "seed", "displacement") if quick else FORMULATIONS:
        given = QUICK_LEVELS if quick else LEVELS
        if not FORMULATIONS[formulation].exact:
            given = INEXACT_LEVELS
        for d, levels in given.items():
            if quick and d == 3 and formulation != "symmetric":
                continue
            for motion in ("static", "dynamic"):
                cases += [case(formulation, d, motion, "condensed", n) for n in levels]
    for solver in SOLVERS:
        if solver != "condensed":
            cases += [case("symmetric", 2, "static", solver, n) for n in LEVELS[2]]
    return cases


def case(formulation: str, d: int, motion: str, solver: str, n: int) -> Parameters:
    """The parameters of a case with n cells along each edge of the unit cube."""
    return {
        **{"formulation": formulation, "dimension": d, "motion": motion},
        **{"solver": solver, "cells": n},
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
    msh = box(comm, size=(1.0,) * d, cells=(n,) * d).mesh
    fields = form.fields(msh)
    u = fields[0]
    V = u.function_space
    X = ufl.SpatialCoordinate(msh)
    t: Any = fem.Constant(msh, 1.0)
    F = ufl.variable(ufl.Identity(d) + ufl.grad(_exact(X, t)))
    P = ufl.diff(PSI(F), F)  # this Ψ(S) depends on |S|² and det S, which are those of F
    dx = ufl.dx(metadata={"quadrature_degree": DEGREE})
    energy = form.density(*fields, PSI) * ufl.dx - ufl.inner(P, ufl.grad(u)) * dx
    points = V.element.interpolation_points
    at_t, velocity = (
        fem.Expression(e, points) for e in (_exact(X, t), (_exact(X, t) - _exact(X, t - H)) / H)
    )
    steps = STEPS if parameters["motion"] == "dynamic" else 1
    t.value = 1.0 - H * (steps if parameters["motion"] == "dynamic" else 0)
    u.interpolate(at_t)
    scheme = BackwardEuler(u, H)
    if parameters["motion"] == "dynamic":
        scheme.v.interpolate(velocity)
        acceleration = (_exact(X, t) - 2 * _exact(X, t - H) + _exact(X, t - 2 * H)) / H**2
        energy += scheme.kinetic(RHO) * ufl.dx - RHO * ufl.inner(acceleration, u) * dx
    msh.topology.create_connectivity(d - 1, d)
    boundary = fem.Function(V)
    facets = exterior_facet_indices(msh.topology)
    bc = fem.dirichletbc(boundary, fem.locate_dofs_topological(V, d - 1, facets))
    # Where Newton's method is linear it takes its time.
    options = None if form.exact else {"snes_max_it": 1000}
    problem = MixedProblem(energy, fields, [bc], solver=parameters["solver"], options=options)
    iterations = []
    for _ in range(steps):
        if parameters["motion"] == "dynamic":
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
        "Lam": (form.multiplier(*fields, PSI), P),
    }
    errors = _errors(msh, expressions)
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


def _errors(msh: Any, pairs: dict[str, tuple[Expr, Expr]]) -> dict[str, float]:
    """Squared L2 norms over this rank's cells of the differences; S is that of the exact F."""
    d = msh.geometry.dim
    kind = {2: basix.CellType.triangle, 3: basix.CellType.tetrahedron}[d]
    points, weights = (np.array(a, dtype=float) for a in basix.make_quadrature(kind, DEGREE))
    cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)

    def at(expression: Expr) -> Array:
        return np.array(fem.Expression(expression, points).eval(msh, cells), dtype=float)

    measure = np.abs(at(ufl.JacobianDeterminant(msh)))
    squares = {}
    for name, (computed, exact) in pairs.items():
        reference = at(exact).reshape(len(cells), len(points), -1)
        if name == "S":
            reference = _stretch(reference.reshape(*reference.shape[:2], d, d)).reshape(
                reference.shape
            )
        difference = at(computed).reshape(reference.shape) - reference
        density = np.sum(difference**2, axis=2) * measure.reshape(len(cells), len(points))
        squares[name] = float(np.sum(density @ weights))
    return squares


def _stretch(F: Array) -> Array:
    """√(FᵀF), the right stretch of F with det F > 0."""
    values, vectors = np.linalg.eigh(np.swapaxes(F, -1, -2) @ F)
    S: Array = (vectors * np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return S


# What to show


def _series(records: Sequence[Record]) -> dict[tuple[str, int, str, str], list[Record]]:
    """Records of growing fineness by formulation, dimension, motion and solver."""
    series: dict[tuple[str, int, str, str], list[Record]] = {}
    for r in records:
        key = r["formulation"], r["dimension"], r["motion"], r["solver"]
        series.setdefault(key, []).append(r)
    return series


def orders(levels: Sequence[Record]) -> dict[str, float]:
    """The order of each error, fitted over the finest three levels that did not fail."""
    finest = [r for r in levels if not r["failure"]][-3:]
    if len(finest) < 2:
        return dict.fromkeys(ORDERS, float("nan"))
    h = np.log([1.0 / r["cells"] for r in finest])
    return {name: float(np.polyfit(h, np.log([r[name] for r in finest]), 1)[0]) for name in ORDERS}


def table(records: Sequence[Record]) -> list[str]:
    """The finest errors and the orders."""
    lines = [
        "",
        "Error on the finest mesh and its order over the finest three:",
        "",
        f"{'formulation':<16} {'':<12} {'solver':<10} {'cells':>5}  "
        + "  ".join(f"{name:>15}" for name in ORDERS),
    ]
    for (formulation, d, motion, solver), levels in _series(records).items():
        found = orders(levels)
        for r in levels:
            start = f"{formulation:<16} {f'{d}D {motion}':<12} {solver:<10} {r['cells']:>5}  "
            if r["failure"]:
                lines.append(f"{start}fails: {r['failure']}")
            elif r is [level for level in levels if not level["failure"]][-1]:
                cells = "  ".join(f"{r[name]:>9.2e} {found[name]:>5.2f}" for name in ORDERS)
                lines.append(start + cells)
    return lines


def verdict(records: Sequence[Record]) -> list[str]:
    """Exact Newton methods that fail, and orders that are more than 0.1 below what is expected."""
    lines = []
    for key, levels in _series(records).items():
        name = ", ".join(map(str, key))
        if FORMULATIONS[key[0]].exact:
            lines += [f"{name}, {r['cells']} cells: {r['failure']}" for r in levels if r["failure"]]
        found = orders(levels)
        lines += [
            f"{name}: {error} has order {found[error]:.2f}, expected {ORDERS[error]}"
            for error in ORDERS
            if not found[error] >= ORDERS[error] - 0.1
        ]
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Errors of the first formulation over the mesh size, 2D and 3D, static and dynamic."""
    shown = {
        key: levels
        for key, levels in _series(records).items()
        if (key[0], key[3]) == (records[0]["formulation"], records[0]["solver"])
    }
    dimensions = sorted({d for _, d, _, _ in shown})
    figure.set_size_inches(4.5 * len(dimensions), 4.0)
    plots = figure.subplots(1, len(dimensions), squeeze=False)[0]
    for (formulation, d, motion, _), levels in shown.items():
        plot = plots[dimensions.index(d)]
        done = [r for r in levels if not r["failure"]]
        h = np.array([1.0 / r["cells"] for r in done])
        style = "o-" if motion == "static" else "s--"
        for k, (name, order) in enumerate(ORDERS.items()):
            values = [r[name] for r in done]
            label = f"{TITLES[name]}, {motion}"
            plot.loglog(h, values, style, ms=4, color=f"C{k}", label=label)
            plot.loglog(h, 0.7 * values[-1] * (h / h[-1]) ** order, "k:", lw=0.7)
        plot.set(xlabel="mesh size [m]", title=f"{d}D, {formulation}; dotted: orders expected")
        plot.grid(alpha=0.3)
        plot.legend(fontsize=7)
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
