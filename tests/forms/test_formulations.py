"""Every formulation with every solver and materials of each kind, in two dimensions; some in three.

One problem a formulation, compiled once, holds its materials behind switches: all of them with
`symmetric` and the displacement alone, else one of each kind. `tests/solvers/test_engine.py` has
all of them with every formulation.
"""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assign

from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    Hencky,
    StableNeoHookean,
    deformation_gradient,
    mixed_fields,
    quaternion_rotation,
    right_stretch,
)
from forms.formulations.base import rest_shear_modulus
from solvers import SOLVERS, MixedProblem
from tests.bodies import FORGOTTEN, INEXACT, LOCAL, NU, RHO, SOME, Body, E, H, largest
from tests.states import (
    dense,
    field_vector,
    random_values,
    small_mesh,
)
from tests.taylor import check_taylor_orders, jacobian, residual

COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def bodies():
    """A body for each formulation, made when first asked for."""

    class Bodies(dict):
        def __missing__(self, formulation):
            self[formulation] = Body(formulation, materials=materials_with(formulation))
            return self[formulation]

    return Bodies()


def materials_with(formulation):
    return tuple(MATERIALS) if formulation in ("symmetric", "displacement") else SOME


@pytest.mark.parametrize("d", [2, 3])
def test_rest_shear_modulus(d):
    """That of every material is Lamé's μ."""
    _, S, _ = mixed_fields(small_mesh(d))
    for name, material in MATERIALS.items():
        modulus = rest_shear_modulus(material(E=2.6, nu=0.3), S)
        modulus.refresh()
        np.testing.assert_allclose(modulus.x.array, 1.0, rtol=1e-12, err_msg=name)


PAIRS = [(formulation, psi) for formulation in LOCAL for psi in materials_with(formulation)]


@pytest.fixture(scope="module")
def solutions(bodies):
    """Displacement, S and Λ of the displacement method, for each material."""
    body, found = bodies["displacement"], {}
    for material in MATERIALS:
        body.psi.select(material)
        body.solve("direct")
        found[material] = body.fields[0].x.array.copy(), *body.cellwise()
    return found


@pytest.mark.serial
@pytest.mark.parametrize(("formulation", "material"), PAIRS)
def test_taylor(bodies, formulation, material):
    """Far from rest; where derivatives are forgotten, order one in the blocks that have them."""
    body = bodies[formulation]
    body.psi.select(material)
    body.start()
    body.move()
    check_taylor_orders(body.problems["direct"], body.energy, E, FORGOTTEN.get(formulation, ()))


@pytest.mark.parametrize(("formulation", "material"), PAIRS)
def test_every_solver_finds_the_positions_of_the_displacement_method(
    bodies, solutions, formulation, material
):
    """To 1e-9, with the stretch and the stress that belong to them."""
    body, (u, *state) = bodies[formulation], solutions[material]
    assert largest(u) > 0.25  # half of a cell's size
    body.psi.select(material)
    for solver in SOLVERS:
        result = body.solve(solver)
        assert largest(body.fields[0].x.array - u) < 1e-9
        if body.form.exact:
            assert result.iterations <= 6
        for mine, other in zip(body.cellwise(), state, strict=True):
            assert largest(mine - other) < 1e-9 * E


@pytest.mark.serial
@pytest.mark.parametrize("formulation", LOCAL)
def test_newton_stops_at_round_off(formulation):
    """However small a tolerance, and whatever rounding errors a formulation makes."""
    body = Body(formulation, 2, StableNeoHookean(E, NU), solvers=("direct",))
    snes = body.problems["direct"].problem.solver
    snes.setTolerances(rtol=1e-30)
    residuals = body.solve("direct").residuals
    assert min(residuals) < 1e-13 * max(residuals)
    assert residuals[-1] < 10 * min(residuals)


@pytest.mark.serial
@pytest.mark.parametrize("formulation", ["rotation-field", "gauss-newton", "log-strain"])
def test_in_three_dimensions(formulation):
    """The positions of `symmetric`, where the code is not that of 2D, and Taylor orders of exp."""
    psi = StableNeoHookean(E, NU)
    body = Body(formulation, 3, psi, solvers=("condensed",))
    body.solve()
    u = body.fields[0].x.array.copy()
    assert largest(u) > 0.25
    if formulation == "log-strain":
        body.move()
        check_taylor_orders(body.assembled, body.energy, E)
    reference = Body("symmetric", 3, psi, solvers=("condensed",))
    reference.solve()
    assert largest(reference.fields[0].x.array - u) < 1e-9


# The rate of Newton's method where derivatives are forgotten


@pytest.mark.parametrize("formulation", INEXACT)
def test_linear_rate(formulation):
    """The residual falls by the spectral radius of 1 - J̃⁻¹ J, J̃ the matrix with, J without lags.

    J, the derivative of the refreshed residual, is found by finite differences. The rate goes to
    zero with the load, as the stress does that multiplies what is forgotten.
    """
    rates = []
    for g in (-8.0, -2.0):
        body = Body(formulation, 2, StableNeoHookean(E, NU), solvers=("direct",), g=g)
        r = np.array(body.solve("direct").residuals)
        assert len(r) > 9
        rates.append(r[-1] / r[-2])
        assert rates[-1] == pytest.approx(contraction(body), rel=0.1)
    assert 0.1 < rates[0] < 0.9
    assert 2.5 < rates[0] / rates[1] < 6.0


def contraction(body):
    """Spectral radius of the iteration on the unknowns that are not clamped."""
    problem = body.problems["direct"]
    approximate = dense(jacobian(problem))
    n = len(approximate)
    state = field_vector(problem, [f.x.array for f in problem.fields])
    x, exact = state.duplicate(), np.empty((n, n))
    first, last = x.getOwnershipRange()
    for j in range(n):
        columns = []
        for step in (1e-5, -1e-5):
            state.copy(x)
            if first <= j < last:
                x.setValue(j, step, addv=PETSc.InsertMode.ADD)
            x.assemble()
            put(problem, x)
            columns.append(np.concatenate(COMM.allgather(residual(problem).array_r)))
        exact[:, j] = (columns[0] - columns[1]) / 2e-5
    put(problem, state)
    marks = [np.zeros_like(f.x.array) for f in problem.fields]
    marks[0].reshape(-1, 2)[body.clamped] = 1.0
    clamped = np.concatenate(COMM.allgather(field_vector(problem, marks).array_r)) > 0.5
    free = np.ix_(~clamped, ~clamped)
    lost = np.eye(n)[free] - np.linalg.solve(approximate[free], exact[free])
    return np.abs(np.linalg.eigvals(lost)).max()


def put(problem, x):
    x.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
    assign(x, problem.fields)


# What single formulations promise


def test_the_iteration_of_gauss_newton_is_definite_under_any_stress(bodies):
    """Under large pressure the exact condensed matrix is indefinite, Gauss-Newton's is not."""
    lowest = {}
    for formulation in ("symmetric", "gauss-newton"):
        body = bodies[formulation]
        body.psi.select("stable-neo-hookean")
        body.start()
        Y = body.fields[2]
        Y.x.array[:] = np.tile([-4.0 * E, 0.0, -4.0 * E], len(Y.x.array) // 3)
        problem = body.problems["condensed"]
        problem.newton_step()
        lowest[formulation] = np.linalg.eigvalsh(dense(problem.condensed.K)).min()
    assert lowest["symmetric"] < 0.0 < lowest["gauss-newton"]


def test_log_strain_stays_in_the_domain():
    """Under a load at which full steps of `symmetric` leave the domain of log S."""
    results = {
        formulation: Body(formulation, 2, Hencky(E, NU), solvers=("condensed",), g=-14.0).solve()
        for formulation in ("symmetric", "log-strain")
    }
    assert results["symmetric"].notes  # a line search had to come to the rescue
    assert not results["log-strain"].notes
    assert results["log-strain"].iterations <= 10


@pytest.mark.parametrize("d", [2, 3])
def test_quaternions_give_rotations(d):
    """R(q) is orthogonal for q of any length, and turns about the axis of q by twice its angle."""
    msh = small_mesh(d)
    q = fem.Function(fem.functionspace(msh, ("DG", 0, (2 * d - 2,))))
    q.x.array[:] = 1.5 * random_values(q, 5)
    points = np.full((1, d), 1 / (d + 1))
    cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)
    R = fem.Expression(quaternion_rotation(q), points).eval(msh, cells)[:, 0]
    identity = np.broadcast_to(np.eye(d), R.shape)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=1e-14)
    values = q.x.array.reshape(-1, 2 * d - 2)[q.function_space.dofmap.list[cells, 0]]
    if d == 3:
        axis = values[:, 1:]
        np.testing.assert_allclose(np.einsum("nij,nj->ni", R, axis), axis, atol=1e-13)
        angle = 2 * np.arctan2(np.linalg.norm(axis, axis=1), values[:, 0])
        np.testing.assert_allclose(np.trace(R, axis1=1, axis2=2), 1 + 2 * np.cos(angle))
    else:
        angle = np.arctan2(values[:, 1], values[:, 0])
        np.testing.assert_allclose(R[:, 1, 0], np.sin(angle), atol=1e-14)


# One of a user's own


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_formulation_written_here(solver):
    """The volume ratio as a field of its own, beside the stretch; unknown to the packages."""
    psi = StableNeoHookean(E, NU)
    reference = Body("displacement", 2, psi, solvers=("direct",))
    reference.solve("direct")
    msh = reference.mesh
    u, S, Y = FORMULATIONS["symmetric"].fields(msh)
    dg0 = fem.functionspace(msh, ("DG", 0))
    theta, p = fem.Function(dg0, name="theta"), fem.Function(dg0, name="p")
    theta.x.array[:] = 1.0
    stretched = psi.mu / 2 * (ufl.inner(S, S) - 2 + 2 * (1 - theta))
    volumetric = psi.lam / 2 * (theta - 1) ** 2
    constraints = ufl.inner(Y, S - right_stretch(deformation_gradient(u))) + p * (
        theta - ufl.det(deformation_gradient(u))
    )
    scheme = BackwardEuler(u, H, (0.0, -2.0))
    energy = (stretched + volumetric - constraints + scheme.kinetic(RHO)) * ufl.dx
    bc = fem.dirichletbc(np.zeros(2), reference.clamped, u.function_space)
    options = {"snes_rtol": 1e-13}
    result = MixedProblem(energy, (u, S, Y, theta, p), [bc], solver=solver, options=options).solve()
    assert result.iterations <= 6
    assert largest(u.x.array - reference.fields[0].x.array) < 1e-9
