"""Block preconditioners: exact where the blocks are, the same states, and open to PETSc options."""

from __future__ import annotations

import gc
import logging
import weakref

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import FORMULATIONS, MATERIALS, BackwardEuler, deformation_gradient, displacement_field
from solvers import PRECONDITIONERS, ConvergenceError, MixedProblem
from tests.states import (
    FIRST,
    dense,
    global_norm,
    random_directions,
    random_values,
    small_mesh,
)

COMM = MPI.COMM_WORLD
E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4
DISPLACEMENT = "fieldsplit_u_Y_fieldsplit_u_"


def build(
    d, formulation="symmetric", material="stable-neo-hookean", solver="fieldsplit", **options
):
    """A clamped body at rest."""
    form = FORMULATIONS[formulation]
    fields = form.fields(small_mesh(d))
    u = fields[0]
    psi = MATERIALS[material](E, NU)
    kinetic = BackwardEuler(u, H, (0.0, -9.81, 1.0)[:d]).kinetic(RHO)
    energy = form.density(*fields, psi) * ufl.dx + kinetic * ufl.dx
    clamped = fem.locate_dofs_geometrical(u.function_space, lambda X: X[0] < 0.2)
    bcs = [fem.dirichletbc(np.zeros(d), clamped, u.function_space)]
    return MixedProblem(energy, fields, bcs, solver=solver, **options)


def states(problem):
    """Copies of the fields."""
    return [f.x.array.copy() for f in problem.fields]


def agree(ours, reference, tolerance=1e-9):
    """Whether two states are the same."""
    for a, b in zip(ours, reference, strict=True):
        assert global_norm(COMM, a - b) < tolerance * global_norm(COMM, b)


def whole(matrix):
    """A matrix of any type as an array on every rank, in the order of its unknowns."""
    x, y = matrix.createVecs()
    columns = []
    for k in range(matrix.size[1]):
        first, last = x.getOwnershipRange()
        x.array_w[:] = np.arange(first, last) == k
        matrix.mult(x, y)
        columns.append(np.concatenate(COMM.allgather(y.array_r.copy())))
    return np.array(columns).T


def everywhere(indices):
    """All indices of an index set, rank by rank."""
    return np.concatenate(COMM.allgather(indices.getIndices().copy()))


@pytest.mark.parametrize(("d", "formulation", "material"), FIRST)
def test_exact_blocks_need_one_iteration(d, formulation, material):
    """Full elimination with exact inverses is an exact solver, and takes `direct`'s steps."""
    problem = build(d, formulation, material)
    result = problem.solve()
    assert set(result.krylov) == {1} and len(result.krylov) == result.iterations
    reference = build(d, formulation, material, "direct")
    assert reference.solve().iterations == result.iterations
    agree(states(problem), states(reference))


@pytest.mark.parametrize("formulation", ["seed", "displacement"])
@pytest.mark.parametrize("preconditioner", PRECONDITIONERS)
def test_every_preconditioner_converges_to_the_same_state(preconditioner, formulation):
    problem = build(2, formulation, preconditioner=preconditioner)
    result = problem.solve()
    reference = build(2, formulation, solver="direct")
    assert reference.solve().iterations == result.iterations
    agree(states(problem), states(reference))
    if preconditioner == "block-triangular-mumps" and formulation == "seed":
        # L U with U as preconditioner: L - I is nilpotent, of order three with three blocks.
        assert max(result.krylov) == 3


def test_preconditioners_in_3d():
    """Multigrid with rigid-body modes on the condensed matrix, inside each kind of elimination."""
    reference = build(3, solver="direct")
    iterations = reference.solve().iterations
    for name in ("schur-full-gmres", "block-triangular-gamg", "block-diagonal-gamg"):
        problem = build(3, preconditioner=name)
        assert problem.solve().iterations == iterations
        agree(states(problem), states(reference))


@pytest.mark.parametrize(("d", "formulation"), [(2, "seed"), (2, "symmetric"), (3, "symmetric")])
def test_eliminations_are_schur_complements(d, formulation):
    """Eqs. (35), (41), condensed matrix: each assembled matrix against that of the whole one."""
    problem = build(d, formulation)
    for f, change in zip(problem.fields, random_directions(problem.fields, stress=E), strict=True):
        f.x.array[:] += 0.3 * change
    u = problem.fields[0]
    u.x.array[u.function_space.tabulate_dof_coordinates()[:, 0].repeat(d) < 0.2] = 0.0
    problem.newton_step()
    blocks = problem.fieldsplit.blocks
    assert problem.fieldsplit.elimination.groups == ((1,), (2,))
    A = whole(problem.problem.A)
    for system, splits in zip(blocks.systems[:-1], blocks.splits, strict=True):
        g, r = map(everywhere, splits)
        np.testing.assert_allclose(whole(system), A, rtol=0, atol=1e-12 * np.abs(A).max())
        schur = A[np.ix_(r, r)] - A[np.ix_(r, g)] @ np.linalg.solve(
            A[np.ix_(g, g)], A[np.ix_(g, r)]
        )
        A = schur
    K = dense(blocks.K)
    assert np.linalg.norm(K - A) < 1e-11 * np.linalg.norm(A)


def own_energy(solver, density, **options):
    """A displacement, two scalar cell-local fields p and theta, and a load; solved."""
    msh = small_mesh(3)
    u = displacement_field(msh)
    dg0 = fem.functionspace(msh, ("DG", 0))
    p, theta = fem.Function(dg0, name="p"), fem.Function(dg0, name="theta")
    theta.x.array[:] = 1.0
    V = u.function_space
    clamped = fem.locate_dofs_geometrical(V, lambda X: X[0] < 0.2)
    load = ufl.inner(u, ufl.as_vector((0.0, -0.3, 0.2))) * ufl.dx
    problem = MixedProblem(
        density(deformation_gradient(u), p, theta) * ufl.dx - load,
        (u, p, theta),
        [fem.dirichletbc(np.zeros(3), clamped, V)],
        solver=solver,
        **options,
    )
    return problem, problem.solve()


def volumetric(F, p, theta):
    """Pressure and volume ratio (Simo, Taylor, Pister 1985)."""
    J = ufl.det(F)
    isochoric = E / 2 * (J ** (-2 / 3) * ufl.inner(F, F) - 3)
    return isochoric + 500 * E * (theta - 1) ** 2 + p * (J - theta)


def saddle(F, p, theta):
    """Neither field has an invertible block of its own: (0, 1; 1, 0) a cell."""
    return E / 2 * ufl.inner(F - ufl.Identity(3), F) + (p - ufl.tr(F)) * (theta - ufl.det(F))


@pytest.mark.parametrize(
    ("density", "groups"),
    [
        (volumetric, ((2,), (1,))),  # the pressure has no block until theta is gone
        (saddle, ((1, 2),)),
    ],
)
@pytest.mark.parametrize("preconditioner", ["schur-full", "block-diagonal-mumps"])
def test_an_energy_of_ones_own(density, groups, preconditioner):
    """The order of elimination follows from the energy."""
    problem, result = own_energy("fieldsplit", density, preconditioner=preconditioner)
    assert problem.fieldsplit.elimination.groups == groups
    assert preconditioner != "schur-full" or set(result.krylov) == {1}
    reference, _ = own_energy("direct", density)
    agree(states(problem), states(reference))


def test_an_energy_on_parts_of_the_cells():
    """A field that couples on some cells only, where alone its rows have entries of u."""
    answers = []
    for solver in ("fieldsplit", "direct"):
        msh = small_mesh(2)
        u = displacement_field(msh)
        q = fem.Function(fem.functionspace(msh, ("DG", 1)), name="q")
        right = mesh.locate_entities(msh, 2, lambda X: X[0] > 0.4)
        dx = ufl.Measure("dx", msh, subdomain_data=mesh.meshtags(msh, 2, right, 1))
        F = deformation_gradient(u)
        energy = (ufl.inner(F, F) + ufl.inner(u, u) + q**2) * dx + q * ufl.tr(F) ** 2 * dx(1)
        problem = MixedProblem(energy, (u, q), solver=solver)
        problem.solve()
        answers.append(states(problem))
    agree(*answers)


def test_options_override_and_unused_ones_are_reported(caplog):
    options = {
        "ksp_type": "gmres",
        f"{DISPLACEMENT}pc_type": "gamg",
        "fieldsplit_u_Y_fieldsplit_v_pc_type": "gamg",
    }
    problem = build(2, options=options)
    prefix = problem.problem.solver.getOptionsPrefix()
    with caplog.at_level(logging.WARNING, "mixed_fem"):
        result = problem.solve()
        problem.solve()
    assert max(result.krylov) > 1
    assert problem.problem.solver.getKSP().getType() == "gmres"
    unused = f"options that nothing has used: {prefix}fieldsplit_u_Y_fieldsplit_v_pc_type"
    assert [r.getMessage() for r in caplog.records] == [unused] * (COMM.rank == 0)


def test_the_command_line_wins():
    """Prefixes are unique, so that the next one is known."""
    before = build(2)
    number = int(before.problem.solver.getOptionsPrefix().split("_")[2]) + 1
    option = f"mixed_fem_{number}_ksp_type"
    PETSc.Options()[option] = "gmres"
    try:
        problem = build(2, options={"ksp_type": "bcgs"})
        problem.solve()
        assert problem.problem.solver.getKSP().getType() == "gmres"
        other = build(2)
        other.solve()
        assert other.problem.solver.getKSP().getType() == "fgmres"
    finally:
        PETSc.Options().delValue(option)


def test_options_leave_with_their_problem():
    problem = build(2)
    problem.solve()
    prefix = problem.problem.solver.getOptionsPrefix()
    assert any(name.startswith(prefix) for name in PETSc.Options().getAll())
    reference = weakref.ref(problem)
    del problem
    gc.collect()
    assert reference() is None
    assert not any(name.startswith(prefix) for name in PETSc.Options().getAll())


@pytest.mark.parametrize("solver", ["fieldsplit", "direct"])
def test_monitors_print_the_norms_of_each_field(solver, capfd):
    options = {"monitor_newton": True, "monitor_krylov": True}
    problem = build(2, solver=solver, options=options)
    result = problem.solve()
    lines = COMM.bcast(capfd.readouterr().out).splitlines()
    newton = [line.split() for line in lines if line.startswith("Newton")]
    assert [int(line[1]) for line in newton] == list(range(result.iterations + 1))
    for line, norms in zip(newton, result.norms, strict=True):
        assert line[2::2] == ["|r_u|", "|r_S|", "|r_Y|"]
        np.testing.assert_allclose([float(n) for n in line[3::2]], list(norms.values()), rtol=1e-6)
    if solver == "fieldsplit":
        krylov = [line.split() for line in lines if line.lstrip().startswith("Krylov")]
        assert len(krylov) == sum(k + 1 for k in result.krylov)
        # The residual of the first linear solve starts as that of Newton's method.
        assert krylov[0][3::2] == newton[0][3::2]


def test_a_linear_solver_that_fails_says_so():
    """MINRES on a body under such pressure that the condensed matrix is indefinite."""
    problem = build(3, preconditioner="block-diagonal-mumps")
    problem.fields[2].x.array.reshape(-1, 6)[:] = -2.0 * E * np.array([1.0, 0, 1.0, 0, 0, 1.0])
    start = states(problem)
    with pytest.raises(ConvergenceError, match=r"DIVERGED_LINEAR_SOLVE \(DIVERGED_INDEFINITE_PC\)"):
        problem.solve()
    for values, before in zip(states(problem), start, strict=True):
        np.testing.assert_array_equal(values, before)
    # The full factorisation takes the exact step there.
    full, direct = build(3), build(3, solver="direct")
    for other in (full, direct):
        other.fields[2].x.array[:] = start[2]
        assert other.newton_step(apply=True).result.krylov == [1]
    agree(states(full), states(direct), tolerance=1e-8)


def test_what_is_refused():
    with pytest.raises(ValueError, match="preconditioner is 'schur'; available: schur-full, schur"):
        build(2, preconditioner="schur")
    with pytest.raises(ValueError, match='a preconditioner goes with "fieldsplit" only'):
        build(2, solver="direct", preconditioner="schur-full")
    msh = small_mesh(2)
    u = displacement_field(msh)
    p = fem.Function(fem.functionspace(msh, ("P", 1)), name="p")
    u.x.array[:] = 0.1 * random_values(u, 1)
    energy = (ufl.inner(ufl.grad(u), ufl.grad(u)) + ufl.inner(u, u) + p**2 + p * u[0]) * ufl.dx
    with pytest.raises(ValueError, match="the field p is not local to cells"):
        MixedProblem(energy, (u, p), solver="fieldsplit")
