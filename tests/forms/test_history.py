"""History variables: a viscous bar in closed form, damage in NumPy, when and where they change."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    AsRigidAsPossible,
    BackwardEuler,
    Fixed,
    History,
    Model,
    Static,
    Stretch,
    Traction,
    deformation_gradient,
    point_field,
)
from meshes import Where, box
from solvers import MixedProblem
from tests.bodies import largest, steps

COMM = MPI.COMM_WORLD
E, NU = 10.0, 0.25
ROLLERS = [Fixed(Where(extents=((axis, "min"),)), components=axis) for axis in "xy"]
RIGHT = Where(extents=(("x", "max"),))


def bar(cell="triangle"):
    return box(COMM, (2.0, 1.0), (4, 2), cell)


@pytest.mark.parametrize(
    ("formulation", "degree"),
    [("symmetric", 1), ("symmetric", 2), ("displacement", 2), ("log-strain", 1)],
)
def test_a_viscous_bar_creeps(formulation, degree):
    """Under a dead force: e = e_end (1 - (1 + h/τ)⁻ⁿ), τ = η/(2μ), of backward Euler, exactly."""
    body, eta, pull = bar(), 6.0, 2.0
    elastic = AsRigidAsPossible(E, NU)
    h = fem.Constant(body.mesh, 0.4)
    S_old = point_field(body.mesh, np.eye(2), degree=degree, symmetric=True, name="S_old")

    def psi(S):
        return elastic(S) + eta / (2 * h) * ufl.inner(S - S_old, S - S_old)

    model = Model(
        body,
        formulation,
        psi,
        loads=[Traction((pull, 0.0), RIGHT)],
        motions=ROLLERS,
        histories=[History(S_old, Model.stretch)],
        degree=degree,
    )
    scheme = Static(model.u, h)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    X = model.u.function_space.tabulate_dof_coordinates()[:, :2]
    tau, found = eta / (2 * elastic.mu), []
    for _ in steps(model, scheme, problem, 5):
        found.append(largest(model.u.x.array) / 2.0)
        assert largest(model.u.x.array.reshape(-1, 2) - X * (found[-1], 0.0)) < 1e-9
    n = np.arange(1, 6)
    exact = pull / (2 * elastic.mu) * (1 - (1 + 0.4 / tau) ** -n)
    np.testing.assert_allclose(found, exact, rtol=1e-8)
    # A step of another length, which Ψ and the scheme share.
    scheme.h.value = 0.1
    next(steps(model, scheme, problem, 1))
    rest = pull / (2 * elastic.mu)
    assert largest(model.u.x.array) / 2.0 == pytest.approx(
        rest + (exact[-1] - rest) / (1 + 0.1 / tau), rel=1e-8
    )


def test_damage_in_numpy():
    """d = max(d, |S - I|): stays when the body is unloaded, and softens what comes after."""
    body = bar()
    elastic = AsRigidAsPossible(E, NU)
    d = point_field(body.mesh, name="d")

    def largest_strain(values):
        return np.maximum(values[:, 0], np.linalg.norm(values[:, 1:], axis=1))

    def state(model, scheme):
        strain = model.stretch(scheme) - ufl.Identity(2)
        return ufl.as_vector([d, *(strain[i, j] for i in range(2) for j in range(2))])

    pulled = [0.1, 0.3, 0.2, 0.0]
    model = Model(
        body,
        "symmetric",
        lambda S: (1 - d) * elastic(S),
        motions=[
            *ROLLERS,
            Stretch(RIGHT, lambda t: pulled[round(t) - 1] if t else 0.0, components="x"),
        ],
        histories=[History(d, state, largest_strain)],
    )
    scheme = Static(model.u)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    values, energies = [], []
    for _ in steps(model, scheme, problem, 4):
        values.append(largest(d.x.array))
        energies.append(model.energies(scheme).now()[1])
    # The sides are free: |S - I| is the strain along the bar.
    np.testing.assert_allclose(values, [0.1, 0.3, 0.3, 0.3], atol=1e-9)
    expected = 2.0 * (1 - np.array(values)) * elastic.mu * np.array(pulled) ** 2
    np.testing.assert_allclose(energies, expected, atol=1e-9)


def test_histories_change_together_when_a_step_is_accepted():
    """Each sees the others as they were during the step, and the displacement at its end."""
    body = bar()
    a, b = (point_field(body.mesh, value, name=name) for name, value in (("a", 1.0), ("b", 2.0)))
    before = point_field(body.mesh, np.zeros((2, 2)), name="before")
    model = Model(body, "displacement", AsRigidAsPossible(E, NU), rho=1.0)
    scheme = BackwardEuler(model.u, 0.1)
    rate = (deformation_gradient(model.u) - deformation_gradient(scheme.u_old)) / scheme.h
    model.histories += [History(a, b), History(b, a), History(before, rate)]
    for k in (1, 2):
        model.u.interpolate(lambda X, k=k: k * np.array([X[1], 0.1 * X[0]]))
        model.update(scheme)
        assert (a.x.array[0], b.x.array[0]) == ((1.0, 2.0) if k == 1 else (2.0, 1.0))
        model.accept(scheme)
    assert (largest(a.x.array - 1.0), largest(b.x.array - 2.0)) == (0.0, 0.0)
    assert largest(before.x.array.reshape(-1, 4) - [0.0, 10.0, 1.0, 0.0]) < 1e-12


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_values_at_points(cell, degree):
    """A symmetric tensor that varies within a cell, at each point of the rule."""
    body = bar(cell)
    old = point_field(body.mesh, np.eye(2), degree=degree, symmetric=True, name="old")
    X = ufl.SpatialCoordinate(body.mesh)
    model = Model(body, "displacement", AsRigidAsPossible(E, NU), degree=degree)
    value = ufl.as_matrix([[X[0], X[0] * X[1]], [X[0] * X[1], X[1] ** 2]])
    model.histories.append(History(old, value))
    model.accept(Static(model.u))
    assert len(np.unique(np.round(old.x.array, 6))) > 20
    dx = ufl.dx(metadata={"quadrature_degree": old.ufl_element().embedded_superdegree})
    error = fem.assemble_scalar(fem.form(ufl.inner(old - value, old - value) * dx))
    assert COMM.allreduce(error) < 1e-24
