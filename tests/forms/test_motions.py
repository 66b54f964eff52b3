"""Motions: prescribed values at t, conditions that stay the same objects, free components."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from scipy.optimize import brentq

from forms import (
    AsRigidAsPossible,
    Bend,
    Fixed,
    Model,
    NeoHookean,
    Prescribed,
    Static,
    Stretch,
    Translate,
    Twist,
    deformation_gradient,
)
from meshes import MeshError, Where, box
from solvers import MixedProblem
from tests.bodies import largest, steps

COMM = MPI.COMM_WORLD
SIZE = (2.0, 1.0, 0.5)


def bar(d):
    return box(COMM, SIZE[:d], (4, 2, 2)[:d])


def end(axis, which="max"):
    return Where(extents=((axis, which),))


TURN = 0.7  # [rad]
c, s = np.cos(TURN), np.sin(TURN)
CASES = [
    (2, Fixed(end("x")), lambda X: 0 * X),
    (3, Translate(end("x"), (1.0, 0.0, -2.0)), lambda X: 0 * X + np.array([[0.5], [0.0], [-1.0]])),
    (2, Translate(end("x"), lambda t: (t**2, 0.0)), lambda X: 0 * X + np.array([[0.25], [0.0]])),
    (2, Stretch(end("x"), 0.4, centre=1.0), lambda X: np.array([0.2 * (X[0] - 1.0), 0 * X[0]])),
    (3, Stretch(end("x"), 0.4, "y"), lambda X: np.array([0 * X[0], 0.2 * X[1], 0 * X[0]])),
    (
        2,
        Twist(end("x"), 2 * TURN, centre=(2.0, 0.5)),
        lambda X: np.array(
            [
                (c - 1) * (X[0] - 2.0) - s * (X[1] - 0.5),
                s * (X[0] - 2.0) + (c - 1) * (X[1] - 0.5),
            ]
        ),
    ),
    (
        3,
        Twist(end("x"), lambda t: TURN * 2 * t, "x"),
        lambda X: np.array([0 * X[0], (c - 1) * X[1] - s * X[2], s * X[1] + (c - 1) * X[2]]),
    ),
    (
        3,
        Twist(end("y"), 2 * TURN, "y", centre=(0.0, 9.0, 0.1)),
        lambda X: np.array(
            [
                (c - 1) * X[0] + s * (X[2] - 0.1),
                0 * X[0],
                -s * X[0] + (c - 1) * (X[2] - 0.1),
            ]
        ),
    ),
    (2, Translate(end("x"), (1.0, 0.0), start=0.2), lambda X: 0 * X + np.array([[0.3], [0.0]])),
    (2, Translate(end("x"), (1.0, 0.0), end=0.2), lambda X: 0 * X + np.array([[0.2], [0.0]])),
    (2, Translate(end("x"), (1.0, 0.0), start=0.6), lambda X: 0 * X),
    (
        2,
        Translate(end("x"), table=[(0.0, 0.0, 0.0), (1.0, 1.0, 4.0)]),
        lambda X: 0 * X + np.array([[0.5], [2.0]]),
    ),
    (2, Stretch(end("x"), table=[(0.1, 0.0), (0.3, 0.4)]), lambda X: 0.4 * X * [[1.0], [0.0]]),
    (2, Prescribed(end("x"), lambda X, t: t * X**2), lambda X: 0.5 * X**2),
    # Half a circle of radius 2/π, its centre at (0, 2/π); fibres above the axis are shorter.
    (
        2,
        Bend(end("x"), np.pi),
        lambda X: np.array([-2.0 + 0 * X[0], 4 / np.pi - 2 * X[1]]),
    ),
    (3, Bend(end("x"), 0.0, towards="z"), lambda X: 0 * X),
]


@pytest.mark.parametrize("curvature", [1e-9, 0.3, 2.0])
def test_a_bent_bar_keeps_the_length_of_its_axis_and_its_sections(curvature):
    """And the angle between them: det F = 1 - κη by differences."""
    X, step = np.array([[0.7, 0.3, -0.2]]), 1e-6
    bend = Bend(end("x"), curvature, "x", "z", centre=(0.2, 0.0, 0.1))
    x = lambda X: X + bend.displacement(X, 1.0)  # noqa: E731
    F = np.array([(x(X + step * e) - x(X - step * e))[0] / (2 * step) for e in np.eye(3)]).T
    C = F.T @ F
    eta = X[0, 2] - 0.1
    np.testing.assert_allclose(C, np.diag([(1 - curvature * eta) ** 2, 1.0, 1.0]), atol=1e-8)
    assert np.linalg.det(F) == pytest.approx(1 - curvature * eta, abs=1e-8)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("d", "motion", "exact"), CASES)
def test_values(d, motion, exact, degree):
    """After half a second on the part, and nowhere else."""
    body = bar(d)
    V = fem.functionspace(body.mesh, ("P", degree, (d,)))
    held = motion.hold(body, V)
    (bc,) = held.bcs
    held.set_time(0.5)
    u, expected = fem.Function(V), fem.Function(V)
    u.x.array[:] = expected.x.array[:] = 7.0
    bc.set(u.x.array)
    inside = fem.Function(V)
    inside.interpolate(lambda X: exact(X[:d]))
    blocks = body.dofs(V, motion.where)
    expected.x.array.reshape(-1, d)[blocks] = inside.x.array.reshape(-1, d)[blocks]
    assert COMM.allreduce(len(blocks)) > 2
    assert largest(u.x.array - expected.x.array) < 1e-14
    held.set_time(0.0)
    bc.set(u.x.array)
    assert largest(u.x.array.reshape(-1, d)[blocks]) < 1e-14


def test_one_component():
    """Conditions along the axes that are named; the others stay as they are."""
    body = bar(3)
    V = fem.functionspace(body.mesh, ("P", 1, (3,)))
    held = Translate(end("x"), (1.0, 2.0, 3.0), components="zx").hold(body, V)
    held.set_time(1.0)
    u = fem.Function(V)
    u.x.array[:] = 7.0
    for bc in held.bcs:
        bc.set(u.x.array)
    values = u.x.array.reshape(-1, 3)[body.dofs(V, end("x"))]
    assert largest(values - [1.0, 7.0, 3.0]) == 0.0
    assert len(held.bcs) == 2


@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
def test_a_block_between_rollers(formulation):
    """Stretched by 30 %, sides free: the transverse stretch at which the stress there is zero."""
    psi = NeoHookean(10.0, 0.3)
    model = Model(
        bar(3),
        formulation,
        psi,
        motions=[
            Fixed(end("x", "min"), components="x"),
            Fixed(end("y", "min"), components="y"),
            Fixed(end("z", "min"), components="z"),
            Stretch(end("x"), 0.15, components="x"),
        ],
    )
    scheme = Static(model.u)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    assert all(result.iterations < 10 for result in steps(model, scheme, problem, 2))

    def transverse(a):
        # μ (a - 1/a) + λ ln(J)/a, J = 1.3 a².
        return psi.mu * (a - 1 / a) + psi.lam * np.log(1.3 * a**2) / a

    a = brentq(transverse, 0.5, 1.5)
    X = model.u.function_space.tabulate_dof_coordinates()
    assert largest(model.u.x.array.reshape(-1, 3) - X * (0.3, a - 1, a - 1)) < 1e-9


def test_a_turn_without_strain():
    """With all of its boundary turned by 50 degrees a step the body follows as one."""
    body = box(COMM, (1.0, 1.0), (4, 4))
    motions = [
        Twist(end(axis, which), np.deg2rad(50.0), centre=(0.5, 0.5))
        for axis in "xy"
        for which in ("min", "max")
    ]
    model = Model(body, "symmetric", AsRigidAsPossible(10.0, 0.3), motions=motions)
    scheme = Static(model.u)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    conditions = list(model.bcs)
    for k, _ in enumerate(steps(model, scheme, problem, 8)):
        F = fem.Expression(deformation_gradient(model.u), np.full((1, 2), 1 / 3))
        cells = np.arange(body.mesh.topology.index_map(2).size_local, dtype=np.int32)
        angle = np.deg2rad(50.0 * (k + 1))
        Q = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert largest(F.eval(body.mesh, cells)[:, 0] - Q) < 1e-8
    assert all(a is b for a, b in zip(conditions, model.bcs, strict=True))


@pytest.mark.parametrize(
    ("motion", "error", "message"),
    [
        (Fixed(end("x"), components="z"), ValueError, 'axis is "z"; in 2D it must be one of x, y'),
        (Fixed(end("x"), components=["xy"]), ValueError, 'axis is "xy"; in 2D it must be one of'),
        (Stretch(end("x"), 1.0, "z"), ValueError, 'axis is "z"; in 2D it must be one of x, y'),
        (Twist(end("x"), 1.0, "x"), ValueError, 'Twist: axis is "x"; in 2D it must be "z"'),
        (Twist(end("x"), 1.0, "a"), ValueError, 'axis is "a"; in 3D it must be one of x, y, z'),
        (Bend(end("x"), 1.0, "y"), ValueError, 'Bend: axis and towards are both "y"'),
        (Stretch(end("x"), table=[(0, 1, 2)]), ValueError, "Stretch needs one number at a time"),
        (Translate(end("x"), (1.0,)), ValueError, "rate has 1 components; the body lives in 2D"),
        (Fixed(end("z")), MeshError, "the mesh is 2D and has no z axis"),
    ],
)
def test_what_is_refused(motion, error, message):
    body = bar(2)
    with pytest.raises(error, match=message):
        motion.hold(body, fem.functionspace(body.mesh, ("P", 1, (2,))))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "needs either a rate or a table"),
        ({"rate": 1.0, "table": [(0.0, 1.0)]}, "needs either a rate or a table"),
        ({"rate": 1.0, "start": 2.0, "end": 1.0}, "end is 1 s, before start, 2 s"),
        ({"table": [(0.0,)]}, "table must have rows"),
        ({"table": [(0.0, 1.0), (0.0, 2.0)]}, "table must have rows .* of growing times"),
        ({"table": [(0.0, 1.0), (1.0, 2.0, 3.0)]}, "table must have rows"),
    ],
)
def test_what_no_motion_can_be(keys, message):
    with pytest.raises(ValueError, match=message):
        Stretch(end("x"), **keys)
