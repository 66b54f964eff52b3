"""Motions whose answer is known: rigid, affine, or the one of another formulation."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    BackwardEuler,
    Corotational,
    StableNeoHookean,
    deformation_gradient,
    right_stretch,
)
from solvers import ConvergenceError, MixedProblem, march
from tests.states import FIRST_FORMULATIONS, random_values, small_mesh

RHO = 1000.0  # [kg/m³]
MIXED = [name for name in FIRST_FORMULATIONS if name != "displacement"]


def on_cells(expression, msh):
    """A UFL expression in the middle of each owned cell."""
    d = msh.geometry.dim
    cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)
    return fem.Expression(expression, np.full((1, d), 1 / (d + 1))).eval(msh, cells)[:, 0]


def largest(comm, values):
    return comm.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


def bar(formulation, psi, h, cells=(4, 1, 1)):
    """A bar clamped at x = 0 under gravity."""
    form = FORMULATIONS[formulation]
    corners = [(0.0, 0.0, 0.0), (4.0, 1.0, 1.0)]
    msh = mesh.create_box(MPI.COMM_WORLD, corners, cells)
    fields = form.fields(msh)
    u = fields[0]
    V = u.function_space
    scheme = BackwardEuler(u, h, (0.0, -9.81, 0.0))
    energy = form.density(*fields, psi) * ufl.dx + scheme.kinetic(RHO) * ufl.dx
    clamped = fem.locate_dofs_geometrical(V, lambda X: np.isclose(X[0], 0.0))
    return scheme, MixedProblem(energy, fields, [fem.dirichletbc(np.zeros(3), clamped, V)])


@pytest.mark.parametrize("formulation", MIXED)
def test_mixed_is_the_displacement_method(formulation):
    """P1/DG0/DG0 and P1 share their solutions: positions equal to 1e-10 after 10 steps."""
    psi = StableNeoHookean(E=1e6, nu=0.45)
    positions, iterations = [], []
    for name in (formulation, "displacement"):
        scheme, problem = bar(name, psi, h=0.1)
        iterations.append([result.iterations for result in march(problem, scheme, 10)])
        positions.append(problem.fields[0].x.array)
    comm = MPI.COMM_WORLD
    assert largest(comm, positions[1]) > 0.5  # [m], a large motion
    assert largest(comm, positions[0] - positions[1]) < 1e-10
    assert max(iterations[0]) <= max(iterations[1]) <= 5  # full steps do for both


@pytest.mark.parametrize("formulation", MIXED)
def test_newton_is_quadratic(formulation):
    """From a state far from rest the last residuals fall with order two."""
    _, problem = bar(formulation, StableNeoHookean(E=1e6, nu=0.45), h=0.1)
    u = problem.fields[0]
    free = np.isclose(u.function_space.tabulate_dof_coordinates()[:, 0], 0.0)
    change = 0.1 * random_values(u, 4).reshape(-1, 3)
    change[free] = 0.0
    u.x.array[:] += change.ravel()
    result = problem.solve()
    r = np.array(result.residuals)
    # The last residual before rounding, and the two in front of it.
    last = np.flatnonzero(r > 1e-11 * r[0])[-1]
    assert last >= 2
    order = np.log(r[last] / r[last - 1]) / np.log(r[last - 1] / r[last - 2])
    assert order > 1.8, result.residuals


@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_free_fall(formulation):
    """Without boundary conditions x falls by h² g (1 + 2 + ... + n), unstrained."""
    form, h, g, steps = FORMULATIONS[formulation], 0.1, np.array([1.0, -9.81, 0.0]), 5
    msh = small_mesh(3)
    fields = form.fields(msh)
    psi = StableNeoHookean(E=1e6, nu=0.45)
    scheme = BackwardEuler(fields[0], h, g)
    energy = form.density(*fields, psi) * ufl.dx + scheme.kinetic(RHO) * ufl.dx
    problem = MixedProblem(energy, fields)
    assert all(result.iterations <= 2 for result in march(problem, scheme, steps))
    fallen = h**2 * steps * (steps + 1) / 2 * g
    assert largest(msh.comm, fields[0].x.array.reshape(-1, 3) - fallen) < 1e-12
    assert largest(msh.comm, scheme.v.x.array.reshape(-1, 3) - h * steps * g) < 1e-11
    check_unstrained(problem, form, psi)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_rigid_rotation(d, formulation):
    """Thrown into a rotation by 40 degrees a step, a body follows without strain.

    Backward Euler damps a spin, so that x̃ is rigid only if the velocity is set each step.
    """
    form, h, turn = FORMULATIONS[formulation], 0.1, np.deg2rad(40.0)
    msh = small_mesh(d)
    fields = form.fields(msh)
    u = fields[0]
    psi = Corotational(E=1e4, nu=0.3)
    scheme = BackwardEuler(u, h)
    energy = form.density(*fields, psi) * ufl.dx + scheme.kinetic(RHO) * ufl.dx
    problem = MixedProblem(energy, fields)
    Q = np.eye(d)
    Q[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    X = u.function_space.tabulate_dof_coordinates()[:, :d]
    x = X.copy()
    for _ in range(4):
        scheme.v.x.array[:] = ((x @ Q.T - x) / h).ravel()
        problem.solve()
        scheme.advance()
        x = x @ Q.T
        assert largest(msh.comm, u.x.array - (x - X).ravel()) < 1e-10
        check_unstrained(problem, form, psi)


def check_unstrained(problem, form, psi):
    """S = I, Λ = 0 and no elastic energy, to round-off."""
    problem.refresh()
    msh = problem.fields[0].function_space.mesh
    S = form.stretch(*problem.fields)
    assert largest(msh.comm, on_cells(S - ufl.Identity(S.ufl_shape[0]), msh)) < 1e-10
    assert largest(msh.comm, on_cells(form.stress(*problem.fields, psi), msh)) < 1e-9 * psi.E
    elastic = fem.assemble_scalar(fem.form(psi(S) * ufl.dx))
    assert abs(msh.comm.allreduce(elastic, op=MPI.SUM)) < 1e-12 * psi.E


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_patch(d, formulation):
    """With an affine map prescribed on the boundary, every vertex and cell follows it."""
    form = FORMULATIONS[formulation]
    cells = (4,) * d
    msh = (
        mesh.create_unit_square(MPI.COMM_WORLD, *cells)
        if d == 2
        else mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 2)
    )
    inner = np.all((msh.geometry.x[:, :d] > 0.01) & (msh.geometry.x[:, :d] < 0.99), axis=1)
    msh.geometry.x[inner, :d] += 0.05
    fields = form.fields(msh)
    u = fields[0]
    V = u.function_space
    psi = StableNeoHookean(E=1e5, nu=0.4)
    F = np.array([[1.1, 0.4, 0.1], [-0.3, 0.9, 0.2], [0.1, -0.2, 1.2]])[:d, :d]

    def affine(X):
        return (F - np.eye(d)) @ X[:d]

    prescribed = fem.Function(V)
    prescribed.interpolate(affine)
    msh.topology.create_connectivity(d - 1, d)
    boundary = mesh.exterior_facet_indices(msh.topology)
    dofs = fem.locate_dofs_topological(V, d - 1, boundary)
    problem = MixedProblem(
        form.density(*fields, psi) * ufl.dx, fields, [fem.dirichletbc(prescribed, dofs)]
    )
    problem.solve()
    assert largest(msh.comm, u.x.array - prescribed.x.array) < 1e-11
    # S = sqrt(FᵀF) and Λ = μ F + (λ (J - 1) - μ) cof F, the first Piola-Kirchhoff stress.
    values, vectors = np.linalg.eigh(F.T @ F)
    S = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    J = np.linalg.det(F)
    P = psi.mu * F + (psi.lam * (J - 1) - psi.mu) * J * np.linalg.inv(F).T
    problem.refresh()
    assert largest(msh.comm, on_cells(form.stretch(*fields), msh) - S) < 1e-11
    assert largest(msh.comm, on_cells(form.stress(*fields, psi), msh) - P) < 1e-10 * psi.E


def test_failure_raises_and_restores():
    """Too few iterations: the error tells the history, and the fields are as before."""
    _, problem = bar("symmetric", StableNeoHookean(E=1e6, nu=0.45), h=0.1, cells=(2, 1, 1))
    before = [f.x.array.copy() for f in problem.fields]
    problem.problem.solver.setTolerances(max_it=1)
    with pytest.raises(ConvergenceError, match=r"DIVERGED_MAX_IT") as caught:
        problem.solve()
    assert caught.value.result.iterations == 1
    assert len(caught.value.result.norms) == 2
    assert "|r_u|" in str(caught.value)
    for f, values in zip(problem.fields, before, strict=True):
        np.testing.assert_array_equal(f.x.array, values)


def test_a_collapsed_body_comes_back():
    """From a point, where σ₂ + σ₃ = 0 and there is no rotation, to the same state as from rest.

    The step is so short that inertia leaves it no other.
    """
    found = []
    for start in (0.0, -1.0):
        _, problem = bar("symmetric", StableNeoHookean(E=1e4, nu=0.45), h=0.01, cells=(2, 1, 1))
        u = problem.fields[0]
        u.interpolate(lambda X: start * X)
        problem.solve()
        found.append(u.x.array.copy())
    assert largest(problem.fields[0].function_space.mesh.comm, found[1] - found[0]) < 1e-8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solver": "magic"}, "solver is 'magic'; available: direct"),
        ({"energy": lambda u, S, Y: ufl.inner(S, S) * ufl.dx}, "does not depend on the field u"),
        (
            {"energy": lambda u, S, Y: ufl.TestFunction(u.function_space)[0] * ufl.dx},
            "it must be a functional",
        ),
    ],
)
def test_bad_arguments(change, message):
    u, S, Y = FORMULATIONS["symmetric"].fields(small_mesh(2))
    energy = change.pop(
        "energy", lambda u, S, Y: ufl.inner(Y, S - right_stretch(deformation_gradient(u))) * ufl.dx
    )
    with pytest.raises(ValueError, match=message):
        MixedProblem(energy(u, S, Y), (u, S, Y), **change)
