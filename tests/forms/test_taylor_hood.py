"""Taylor and Hood's pair from a Lagrangian: exact Newton system, orders, no locking, any Ψ."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from demos.studies import cook, locking
from forms import (
    FORMULATIONS,
    BackwardEuler,
    Model,
    StableNeoHookean,
    Static,
    deformation_gradient,
    measure,
    refresh,
)
from solvers import MixedProblem
from tests.bodies import NU, RHO, SOME, Body, E, H, Switch, body_on, largest
from tests.states import small_mesh
from tests.taylor import check_taylor_orders

COMM = MPI.COMM_WORLD
TIGHT = {"snes_rtol": 1e-13}


@pytest.fixture(scope="module")
def body():
    """Triangles, with materials of each kind behind switches."""
    return Body("taylor-hood", solvers=("direct",), materials=SOME)


@pytest.mark.serial
@pytest.mark.parametrize("material", SOME)
def test_taylor(body, material):
    """Far from rest."""
    body.psi.select(material)
    body.start()
    body.move()
    check_taylor_orders(body.problems["direct"], body.energy, E)


@pytest.fixture(scope="module")
def patch():
    """A body all of whose boundary follows an affine map, with materials behind switches."""
    body = body_on(small_mesh(2))
    psi = Switch(body.mesh, SOME)
    model = Model(body, "taylor-hood", psi)
    V = model.u.function_space
    values = fem.Function(V)
    values.interpolate(lambda X: (F - np.eye(2)) @ X[:2])
    body.mesh.topology.create_connectivity(1, 2)
    facets = mesh.exterior_facet_indices(body.mesh.topology)
    bc = fem.dirichletbc(values, fem.locate_dofs_topological(V, 1, facets))
    static = Static(model.u)
    problem = MixedProblem(model.energy(static), model.fields, [bc], solver="direct", options=TIGHT)
    stresses = model.stress(static), FORMULATIONS["displacement"].stress(model.u, psi)
    return model, problem, values, stresses, [f.x.array.copy() for f in model.fields]


F = np.array([[1.15, 0.3], [-0.2, 0.95]])


@pytest.mark.parametrize("material", SOME)
def test_patch(patch, material):
    """An affine map is met exactly, with its stress, the same pressure everywhere and θ = det F."""
    model, problem, affine, stresses, at_rest = patch
    model.psi.select(material)
    for f, values in zip(model.fields, at_rest, strict=True):
        f.x.array[:] = values
    assert problem.solve().iterations <= 8
    u, _, _, theta, p = model.fields
    assert largest(u.x.array - affine.x.array) < 1e-10
    assert largest(theta.x.array - np.linalg.det(F)) < 1e-9
    pressure = p.x.array
    assert largest(pressure - COMM.allreduce(pressure.sum()) / COMM.allreduce(len(pressure))) < 1e-9
    refresh(stresses)
    cells = np.arange(model.body.mesh.topology.index_map(2).size_local, dtype=np.int32)
    points = theta.function_space.element.interpolation_points
    mine, plain = (fem.Expression(e, points).eval(model.body.mesh, cells) for e in stresses)
    assert largest(plain) > 1.0
    assert largest(mine - plain) < 1e-8


@pytest.mark.serial
def test_it_is_the_classical_pair():
    """With S, Y and θ eliminated by hand: a Lagrangian of displacement and pressure alone."""
    psi = StableNeoHookean(E, NU)
    ours = Body("taylor-hood", 2, psi, solvers=("direct",))
    ours.solve("direct")
    u, _, _, _, p = ours.fields
    v, q = fem.Function(u.function_space, name="u"), fem.Function(p.function_space, name="p")
    gradient = deformation_gradient(v)
    J, C = ufl.det(gradient), gradient.T * gradient
    # Ψ of the stretch (θ/J)^½ S, whose square is θ/J C, and θ from ∂Ψ/∂θ = p.
    theta = 1 + (q + psi.mu - psi.mu / 2 * ufl.tr(C) / J) / psi.lam
    isochoric = psi.mu * (1 - theta) + psi.mu / 2 * (theta / J * ufl.tr(C) - 2)
    density = isochoric + psi.lam / 2 * (theta - 1) ** 2 + q * (J - theta)
    scheme = BackwardEuler(v, H, (0.0, -2.0))
    energy = density * measure(v) + scheme.kinetic(RHO) * ufl.dx
    bc = fem.dirichletbc(np.zeros(2), ours.clamped, v.function_space)
    MixedProblem(energy, (v, q), [bc], solver="direct", options=TIGHT).solve()
    assert largest(u.x.array) > 0.25
    assert largest(u.x.array - v.x.array) < 1e-10
    assert largest(p.x.array - q.x.array) < 1e-8


def isochoric(X):
    """A shear that varies across the body: det F = 1."""
    return ufl.as_vector([0.3 * ufl.sin(2 * X[1]), 0.0])


def general(X):
    return ufl.as_vector([0.2 * ufl.sin(2 * X[1]) + 0.1 * X[0] ** 2, 0.1 * ufl.sin(3 * X[0])])


@pytest.mark.serial
@pytest.mark.parametrize(
    ("exact", "nu", "simplices"),
    [(general, 0.3, True), (isochoric, 0.4999, True), (isochoric, 0.4999, False)],
)
def test_orders(exact, nu, simplices):
    """Three of u and two of p in L2, by a manufactured solution, near ν = 1/2, too."""
    psi = StableNeoHookean(10.0, nu)
    cell = mesh.CellType.triangle if simplices else mesh.CellType.quadrilateral
    counts, errors = (4, 8, 16), []
    for n in counts:
        msh = mesh.create_unit_square(COMM, n, n, cell)
        model = Model(body_on(msh), "taylor-hood", psi)
        u, *_, p = model.fields
        static = Static(u)
        X = ufl.SpatialCoordinate(msh)
        gradient = ufl.variable(deformation_gradient(exact(X)))
        P = ufl.diff(psi(gradient), gradient)  # Ψ depends on |S|² and det S, which are those of F
        dx = ufl.dx(metadata={"quadrature_degree": 8})
        energy = model.energy(static) - ufl.inner(P, ufl.grad(u)) * dx
        values = fem.Function(u.function_space)
        values.interpolate(fem.Expression(exact(X), u.function_space.element.interpolation_points))
        left = fem.locate_dofs_geometrical(u.function_space, lambda X: np.isclose(X[0], 0.0))
        bc = fem.dirichletbc(values, left)
        MixedProblem(energy, model.fields, [bc], solver="direct").solve()
        pressure = ufl.tr(P * gradient.T) / (2 * ufl.det(gradient))
        squares = ufl.inner(u - exact(X), u - exact(X)), (p - pressure) ** 2
        found = [COMM.allreduce(fem.assemble_scalar(fem.form(s * dx))) for s in squares]
        errors.append(np.sqrt(found))
    order = -np.diff(np.log(errors), axis=0)[-1] / np.log(2)
    assert order[0] > 2.9
    assert order[1] > 1.9


@pytest.mark.serial
@pytest.mark.parametrize("nu", [0.4999, 0.499975])
def test_cooks_membrane(nu):
    """Within 1 % of the reference, and of the literature where it has a value."""
    record = locking.compute(COMM, locking.case("cook", ("taylor-hood", "triangle", 1), nu, 16))
    assert record["ratio"] == pytest.approx(1.0, abs=0.01)
    _, published = cook.PUBLISHED.get(nu, (None, record["reference"]))
    assert record["tip"] == pytest.approx(published, rel=0.01)


def test_degree_is_that_of_the_pressure():
    msh = small_mesh(2)
    u, S, _, theta, p = FORMULATIONS["taylor-hood"].fields(msh, 2)
    degrees = [f.function_space.element.basix_element.degree for f in (u, p)]
    assert degrees == [3, 2]
    assert S.function_space.dofmap.list.shape == theta.function_space.dofmap.list.shape
    with pytest.raises(ValueError, match="degree is 0; a continuous pressure has degree 1 or more"):
        FORMULATIONS["taylor-hood"].fields(msh, 0)
