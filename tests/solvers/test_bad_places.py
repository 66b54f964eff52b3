"""Where Newton's method is far from a solution: turned ends, crushed and inverted bodies."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import FORMULATIONS, MATERIALS, BackwardEuler, Fixed, Model, Static, Translate, Twist
from forms.inversion import InvertedCells
from meshes import Where, box
from solvers import ConvergenceError, MixedProblem
from tests.bodies import largest

COMM = MPI.COMM_WORLD
LEFT, RIGHT = (Where(extents=(("x", end),)) for end in ("min", "max"))


def turned(formulation, material, angle, **choices):
    """A cube held at one end, whose other end is turned at once."""
    body = box(COMM, (1.0, 1.0, 1.0), (4, 3, 3))
    model = Model(
        body,
        formulation,
        MATERIALS[material](10.0, 0.3),
        motions=[
            Fixed(LEFT),
            Twist(RIGHT, rate=np.radians(angle), axis="x", centre=(1.0, 0.5, 0.5)),
        ],
    )
    scheme = Static(model.u, 1.0)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, **choices)
    model.update(scheme)
    return model, problem


EXACT = [name for name, form in FORMULATIONS.items() if form.exact]


@pytest.mark.parametrize("formulation", [name for name in EXACT if name != "taylor-hood"])
def test_an_end_turned_by_120_degrees(formulation):
    model, problem = turned(formulation, "stable-neo-hookean", 120.0)
    problem.solve()
    if FORMULATIONS[formulation].sees_inversion:
        assert InvertedCells(model.u).count() == 0


@pytest.mark.parametrize(
    ("formulation", "material"),
    [
        *(("symmetric", name) for name in ("neo-hookean", "mooney-rivlin", "ogden", "hencky")),
        *((name, "neo-hookean") for name in ("hu-washizu", "mean-dilatation", "taylor-hood")),
    ],
)
def test_stretches_stay_where_the_energy_has_a_value(formulation, material):
    """Full steps of the whole field would make log det S and the like undefined."""
    model, problem = turned(formulation, material, 60.0)
    result = problem.solve()
    assert InvertedCells(model.u).count() == 0
    if material == "mooney-rivlin":
        assert any("cut: no energy there" in note for note in result.notes.values())
    if formulation == "symmetric":
        alone, displacement = turned("displacement", material, 60.0)
        displacement.solve()
        assert largest(alone.u.x.array - model.u.x.array) < 1e-6


def test_a_failure_names_the_field_that_diverged():
    _, problem = turned("symmetric", "stable-neo-hookean", 170.0, globalisation="residual-search")
    with pytest.raises(ConvergenceError, match=r"the residual has grown .* times, most in [uSY]\)"):
        problem.solve()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_strip_compressed_by_a_tenth(formulation):
    """At once, and straight by symmetry."""
    body = box(COMM, (4.0, 1.0), (16, 4))
    model = Model(
        body,
        formulation,
        MATERIALS["stable-neo-hookean"](1e5, 0.3),
        motions=[Fixed(LEFT), Translate(RIGHT, lambda t: (-0.4 * t, 0.0))],
    )
    scheme = Static(model.u, 1.0)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    model.update(scheme)
    assert problem.solve().iterations < (10 if formulation in EXACT else 30)


@pytest.mark.parametrize("formulation", ["symmetric", "log-strain"])
def test_a_floor_inside_the_body(formulation):
    """Penalty forces of a slope 0.3 m above the lower side: where the displacement's end."""
    ends = []
    for name in (formulation, "displacement"):
        body = box(COMM, (4.0, 1.0, 1.0), (12, 3, 3) if formulation == "symmetric" else (6, 2, 2))
        model = Model(body, name, MATERIALS["stable-neo-hookean"](1e6, 0.4), rho=1000.0)
        scheme = BackwardEuler(model.u, 0.02, (0.0, -9.81, 0.0))
        X = ufl.SpatialCoordinate(body.mesh)
        depth = 0.3 + 0.2 * X[0] - X[1] - model.u[1]
        stiffness = fem.Constant(body.mesh, 1e8)
        floor = ufl.conditional(ufl.gt(depth, 0.0), stiffness / 2 * depth**2, 0.0) * ufl.ds
        problem = MixedProblem(model.energy(scheme) + floor, model.fields)
        for _ in range(4):
            problem.solve()
            model.accept(scheme)
        ends.append(model.u.x.array)
    assert largest(ends[0]) > 1.0
    if formulation == "symmetric":
        assert largest(ends[0] - ends[1]) < 1e-6 * largest(ends[0])


DIRECTION = np.array([2.0, -1.0, 0.5]) / np.sqrt(5.25)


def noise(X, size):
    return np.random.default_rng(1).uniform(-size, size, X.shape)


CRUSHED = {
    "displaced by its size": lambda X: X + noise(X, 1.0),
    "anywhere in the cube": lambda X: 0.5 + noise(X, 0.5),
    "mirrored": lambda X: X * [-1.0, 1.0, 1.0],
    "mirrored at a point, and more": lambda X: noise(X, 0.3) - X,
    "in a plane": lambda X: X * [1.0, 0.0, 1.0],
    "in an oblique plane": lambda X: X - np.outer(X @ DIRECTION, DIRECTION),
    "on a line": lambda X: X * [1.0, 0.0, 0.0],
    "on an oblique line": lambda X: np.outer(X @ DIRECTION, DIRECTION),
    "at a point": lambda X: 0.0 * X,
}
"""What becomes of the vertices of a cube of 1 m."""


@pytest.mark.serial  # random numbers by vertex
@pytest.mark.parametrize(
    ("kind", "material"),
    [*((kind, "as-rigid-as-possible") for kind in CRUSHED), ("at a point", "corotational")],
)
def test_a_crushed_body_comes_back(kind, material):
    """In steps of 10 s, in which inertia is next to nothing."""
    body = box(COMM, (1.0, 1.0, 1.0), (3, 3, 3))
    model = Model(body, "symmetric", MATERIALS[material](1e4, 0.3), rho=1000.0)
    scheme = BackwardEuler(model.u, 10.0)
    X = model.u.function_space.tabulate_dof_coordinates()
    model.u.x.array[:] = scheme.u_old.x.array[:] = (CRUSHED[kind](X) - X).ravel()
    problem = MixedProblem(model.energy(scheme), model.fields)
    for _ in range(12):
        problem.solve()
        model.accept(scheme)
    assert InvertedCells(model.u).count() == 0
    assert model.energies(scheme).now().elastic < 1e-6 * 1e4  # of Young's modulus times volume
