"""Loads: resultants, potentials, the tangent of those that have none, values that change."""

from __future__ import annotations

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem, la, mesh

from forms import (
    BodyForce,
    Gravity,
    HalfSpace,
    ImplicitMidpoint,
    Model,
    PointForce,
    Pressure,
    StableNeoHookean,
    Static,
    Traction,
    deformation_gradient,
    displacement_field,
)
from meshes import Where, box
from tests.bodies import body_on, largest
from tests.states import random_values, small_mesh

COMM = MPI.COMM_WORLD
SIZE = (2.0, 1.0, 0.5)
TOP, RIGHT = (Where(extents=((axis, "max"),)) for axis in ("y", "x"))


def bar(d):
    return box(COMM, SIZE[:d], (3, 2, 2)[:d])


def total(form):
    return COMM.allreduce(fem.assemble_scalar(fem.form(form)))


def force(form, u):
    """The force [N] of a potential: minus its derivative by a translation, along each axis."""
    change = fem.Constant(u.function_space.mesh, np.zeros(len(u)))
    slope, forces = fem.form(ufl.derivative(form, u, change)), []
    for axis in np.eye(len(u)):
        change.value[:] = axis
        forces.append(-COMM.allreduce(fem.assemble_scalar(slope)))
    return np.array(forces)


@pytest.mark.parametrize("d", [2, 3])
def test_resultants(d):
    """Weight, force by volume, force by area: each with the sum of what acts on the body."""
    body, rho = bar(d), 3.0
    u = displacement_field(body.mesh)
    u.x.array[:] = 0.1 * random_values(u, 1)
    volume, axis = float(np.prod(SIZE[:d])), np.eye(d)
    density = fem.Constant(body.mesh, rho)
    weight = Gravity((1.0, -9.81, 2.0)[:d]).energy(body, u, density)
    np.testing.assert_allclose(force(weight, u), rho * volume * np.array((1.0, -9.81, 2.0)[:d]))
    traction = Traction((1.0, 2.0, 3.0)[:d], RIGHT).energy(body, u, None)
    area = float(np.prod(SIZE[1:d]))
    np.testing.assert_allclose(force(traction, u), area * np.array((1.0, 2.0, 3.0)[:d]))
    growing = BodyForce(lambda X, t: [t * X[0]] + [0.0] * (d - 1))
    energy = growing.energy(body, u, None)
    np.testing.assert_allclose(force(energy, u), 0.0, atol=1e-14)
    growing.set_time(2.0)
    np.testing.assert_allclose(force(energy, u), 2.0 * SIZE[0] / 2 * volume * axis[0], atol=1e-14)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("d", [2, 3])
def test_a_force_on_points(d, degree):
    """The same on each vertex of an edge of the body, once, and its work by what they move."""
    body = bar(d)
    u = displacement_field(body.mesh, degree)
    u.interpolate(lambda X: np.array([X[1] ** 2, X[0], X[0] + X[1]][:d]))
    edge = Where(extents=(("x", "max"), ("y", "max")))
    f = np.array((1.0, -9.81, 2.0)[:d])
    energy = PointForce(tuple(f), edge).energy(body, u, None)
    vertices = 3 if d == 3 else 1
    np.testing.assert_allclose(force(energy, u), vertices * f)
    assert total(energy) == pytest.approx(-vertices * f @ np.array((1.0, 2.0, 3.0)[:d]))
    other = PointForce(tuple(f), Where(extents=(("x", "min"), ("y", "min")))).energy(body, u, None)
    np.testing.assert_allclose(force(energy + other, u), 2 * vertices * f)


@pytest.mark.parametrize("d", [2, 3])
def test_a_half_space_pushes_back_by_depth(d):
    """Along its normal, on the part within; nothing beside it."""
    body = bar(d)
    u = displacement_field(body.mesh)
    area = float(np.prod(SIZE[1:d]))
    load = HalfSpace((0.0, -3.0, 0.0)[:d], stiffness=50.0, offset=lambda t: -0.9 - t, where=TOP)
    energy = load.energy(body, u, None)
    within = -50.0 * 0.1 * SIZE[0] * area / SIZE[1] * np.eye(d)[1]
    np.testing.assert_allclose(force(energy, u), within, atol=1e-12)
    load.set_time(0.2)
    assert total(energy) == 0.0
    u.interpolate(lambda X: 0.3 + 0.0 * X[:d])
    top = HalfSpace((0.0, -1.0, 0.0)[:d], stiffness=50.0, offset=-1.1, where=TOP)
    pushed = force(top.energy(body, u, None), u)
    expected = -50.0 * 0.2 * SIZE[0] * area / SIZE[1] * np.eye(d)[1]
    np.testing.assert_allclose(pushed, expected, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_pressure_on_all_sides_is_its_product_with_the_volume(d):
    """Whatever the deformation; its derivative is the force -p n da of each facet."""
    body, p = body_on(small_mesh(d)), 7.0
    u = displacement_field(body.mesh, 2)
    u.x.array[:] = 0.05 * random_values(u, 1)
    load = Pressure(p)
    energy = load.energy(body, u, None)
    volume = total(ufl.det(deformation_gradient(u)) * ufl.dx)
    assert total(energy) == pytest.approx(p * volume, rel=1e-12)
    v = fem.Function(u.function_space)
    v.x.array[:] = random_values(v, 2)
    assert load.work(body, u, v) is None
    n_da = ufl.cofac(deformation_gradient(u)) * ufl.FacetNormal(body.mesh)
    virtual = total(ufl.inner(p * n_da, v) * ufl.ds)
    assert total(ufl.derivative(energy, u, v)) == pytest.approx(virtual, rel=1e-11)
    assert abs(virtual) > 0.1


def hollow():
    """A square of 1.5 m around a square hole of 0.5 m, its middle at the origin."""
    grid = np.array([(i, j) for j in range(4) for i in range(4)], dtype=float) / 2 - 0.75
    corners = np.array([4 * j + i for j in range(3) for i in range(3) if (i, j) != (1, 1)])
    cells = corners[:, None] + [0, 1, 4, 5]
    if COMM.rank > 0:
        cells, grid = np.empty((0, 4), dtype=np.int64), np.empty((0, 2))
    domain = ufl.Mesh(basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,)))
    return body_on(mesh.create_mesh(COMM, cells.astype(np.int64), domain, grid))


def test_pressure_in_a_cavity():
    """A closed part of the boundary: minus p times what is inside, so that it inflates."""
    body, wall = hollow(), (-0.3, 0.3)
    u = displacement_field(body.mesh)
    inner = Where(extents=(("x", wall), ("y", wall)))
    energy = Pressure(2.0, inner, closed=True).energy(body, u, None)
    assert total(energy) == pytest.approx(-2.0 * 0.5**2)
    u.interpolate(lambda X: 0.2 * X[:2])
    assert total(energy) == pytest.approx(-2.0 * 0.6**2)


@pytest.mark.parametrize("d", [2, 3])
def test_pressure_follows(d):
    """On a part that is turned with the body: the force is turned by the same angle."""
    body, p = bar(d), 5.0
    u = displacement_field(body.mesh)
    Q = np.eye(d)
    Q[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]  # a quarter turn
    u.interpolate(lambda X: (Q - np.eye(d)) @ X[:d])
    load = Pressure(p, RIGHT)
    assert load.energy(body, u, None) is None
    work = [total(load.work(body, u, ufl.as_vector(e.tolist()))) for e in np.eye(d)]
    area = float(np.prod(SIZE[1:d]))
    np.testing.assert_allclose(work, -p * area * Q[:, 0], atol=1e-13)


@pytest.mark.parametrize("scheme", [Static, ImplicitMidpoint])
@pytest.mark.parametrize("d", [2, 3])
def test_tangent_of_a_following_pressure(d, scheme):
    """UFL's derivative of the virtual work against differences of it; it is not symmetric."""
    model = Model(bar(d), "displacement", StableNeoHookean(10.0, 0.3), rho=1.0)
    model.loads.append(Pressure(5.0, TOP))
    u = model.u
    made = scheme(u, 0.5)
    made.u_old.x.array[:] = 0.1 * random_values(u, 3)
    u.x.array[:] = 0.1 * random_values(u, 1)
    work = model.virtual_work(made)
    vector, v, w = fem.form(work), fem.Function(u.function_space), fem.Function(u.function_space)
    v.x.array[:], w.x.array[:] = random_values(v, 2), random_values(w, 4)
    tangent = ufl.derivative(work, u)
    start, sides = u.x.array.copy(), []
    for eps in (1e-4, -1e-4):
        u.x.array[:] = start + eps * v.x.array
        sides.append(assembled(vector))
    u.x.array[:] = start
    difference = (sides[0] - sides[1]) / 2e-4
    assert largest(difference) > 0.1
    assert largest(difference - assembled(fem.form(ufl.action(tangent, v)))) < 1e-6
    there, back = (total(ufl.action(ufl.action(tangent, f), g)) for f, g in ((v, w), (w, v)))
    assert abs(there - back) > 0.1


def assembled(form):
    """The owned part of a vector."""
    b = fem.assemble_vector(form)
    b.scatter_reverse(la.InsertMode.add)
    return b.array[: b.index_map.size_local * b.block_size].copy()


def test_virtual_work_moves_with_the_point():
    """At the midpoint half of the work at the end, as the point moves by half of u."""
    model = Model(bar(2), "displacement", StableNeoHookean(10.0, 0.3), rho=1.0)
    assert model.virtual_work(Static(model.u)) is None
    model.loads += [Pressure(5.0, TOP), Pressure(3.0, RIGHT)]
    u = model.u
    u.interpolate(lambda X: 0.1 * X[:2])
    midpoint = ImplicitMidpoint(u, 0.5)  # u_old is u
    works = [ufl.action(model.virtual_work(scheme), u) for scheme in (midpoint, Static(u))]
    half, whole = (total(work) for work in works)
    assert half == pytest.approx(whole / 2)
    # -p cof(F) N · u on the top, 2 m at y = 1 m, and on the right, 1 m at x = 2 m.
    assert whole == pytest.approx(-(5.0 * 2.0 * 0.1 + 3.0 * 1.0 * 0.2) * 1.1)


# Values that change


def test_values_change_without_compiling():
    """Numbers, functions of time and constants of the user's own, in one compiled form."""
    body = bar(2)
    u = displacement_field(body.mesh)
    u.x.array[:] = 1.0
    own = fem.Constant(body.mesh, (1.0, 0.0))
    number = Traction((0.0, 0.0), RIGHT)
    loads = [number, Traction(lambda t: (0.0, t), RIGHT), Traction(own, TOP)]
    compiled = fem.form(
        sum(load.energy(body, u, None) for load in loads[1:]) + number.energy(body, u, None)
    )

    def now(t=0.0):
        for load in loads:
            load.set_time(t)
        return -COMM.allreduce(fem.assemble_scalar(compiled))

    assert now() == pytest.approx(2.0)  # own, on 2 m
    assert now(3.0) == pytest.approx(2.0 + 3.0)
    own.value[:] = 0.0, 4.0
    number.value = 5.0, 6.0
    assert now(3.0) == pytest.approx(8.0 + 3.0 + 11.0)


def test_model_takes_loads_at_the_point_of_the_step():
    """At half of the step for the midpoint, and else at its end."""
    model = Model(bar(2), "displacement", StableNeoHookean(10.0, 0.3), rho=1.0)
    load = Traction(lambda t: (t, 0.0), RIGHT)
    model.loads.append(load)
    model.u.x.array[:] = 1.0
    for scheme, t in ((ImplicitMidpoint(model.u, 0.5), 0.25), (Static(model.u, 0.5), 0.5)):
        energy = fem.form(load.energy(model.body, model.u, None))
        model.update(scheme)
        assert -COMM.allreduce(fem.assemble_scalar(energy)) == pytest.approx(t)


# What is refused


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (Gravity((0.0, -9.81, 0.0)), "Gravity: g must be 2 numbers, as the body has dimens"),
        (Traction(1.0, TOP), "Traction: value must be 2 numbers"),
        (Pressure((1.0, 2.0), TOP), "Pressure: value must be one number"),
        (HalfSpace((0.0, 1.0, 0.0), 1.0), "HalfSpace: plane must be a normal of 2 numbers"),
        (HalfSpace((0.0, 0.0), 1.0), "HalfSpace: plane must be a normal of 2 numbers, not all 0"),
        (PointForce(1.0, TOP), "PointForce: force must be 2 numbers"),
        (Gravity((0.0, -9.81)), "Gravity needs a density; give the model one"),
        (Gravity((np.nan, 0.0)), "Gravity: g is .*nan.*; it must be finite"),
        (Traction(lambda t: (np.inf, t), TOP), "Traction: value is .*inf.*; it must be finite"),
    ],
)
def test_what_is_refused(load, message):
    model = Model(bar(2), "displacement", StableNeoHookean(10.0, 0.3), loads=[load])
    scheme = Static(model.u)
    with pytest.raises(ValueError, match=message):
        model.virtual_work(scheme)
        model.energy(scheme)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Traction((1.0, 0.0), table=[]), "rows .time, factor"),
        (lambda: Traction((1.0, 0.0), table=[(0.0, 0.0, 1.0)]), "rows .time, factor"),
        (
            lambda: Gravity((1.0, 0.0), table=[(1.0, 0.0), (0.0, 1.0)]),
            "rows .time, factor., all alike, of growing times",
        ),
        (
            lambda: Pressure(fem.Constant(bar(2).mesh, 1.0), table=[(0.0, 1.0)]),
            "a table goes with numbers, and value is an expression",
        ),
    ],
)
def test_tables_that_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("rho", [0.0, -1.0, np.nan, np.inf])
def test_densities_that_are_refused(rho):
    with pytest.raises(ValueError, match=r"the density .* must be positive and finite"):
        Model(bar(2), "displacement", StableNeoHookean(10.0, 0.3), rho=rho)


def test_a_table_multiplies():
    """Linear between its rows, constant beyond, times what a function of time says."""
    body = bar(2)
    one = fem.Function(fem.functionspace(body.mesh, ("P", 1, (2,))))
    one.x.array[:] = 1.0
    table = [(1.0, 0.0), (2.0, 4.0)]
    for load, factor in (
        (Traction((0.5, 0.0), RIGHT, table=table), lambda t: 0.5),
        (Traction(lambda t: (t, 0.0), RIGHT, table=table), lambda t: t),
    ):
        energy = fem.form(load.energy(body, one, None))
        width = COMM.allreduce(fem.assemble_scalar(fem.form(1.0 * body.ds(RIGHT))))
        for t, multiple in ((0.0, 0.0), (1.0, 0.0), (1.25, 1.0), (2.0, 4.0), (9.0, 4.0)):
            load.set_time(t)
            work = -COMM.allreduce(fem.assemble_scalar(energy))
            assert work == pytest.approx(multiple * factor(t) * width)
