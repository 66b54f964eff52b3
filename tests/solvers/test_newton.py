"""Newton's method from outside: single steps, works, conditions, options by name."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    BackwardEuler,
    Corotational,
    Fixed,
    Model,
    Pressure,
    StableNeoHookean,
    Static,
    displacement_field,
    mixed_fields,
    symmetric,
)
from meshes import Where, box
from solvers import SOLVERS, ConvergenceError, MixedProblem
from tests.states import dense, global_norm, small_mesh

COMM = MPI.COMM_WORLD
E, NU = 10.0, 0.3
LEFT, TOP = Where(extents=(("x", "min"),)), Where(extents=(("y", "max"),))


def falling(formulation="symmetric", **choices):
    """A clamped body about to fall."""
    form = FORMULATIONS[formulation]
    fields = form.fields(small_mesh(2))
    V = fields[0].function_space
    energy = form.density(*fields, StableNeoHookean(E, NU)) * ufl.dx
    energy += BackwardEuler(fields[0], 0.4, (0.0, -9.81)).kinetic(2.0) * ufl.dx
    clamped = fem.locate_dofs_geometrical(V, lambda X: X[0] < 0.2)
    return MixedProblem(energy, fields, [fem.dirichletbc(np.zeros(2), clamped, V)], **choices)


def values(problem):
    return [f.x.array.copy() for f in problem.fields]


# Single steps


@pytest.mark.parametrize("solver", SOLVERS)
def test_steps_make_up_a_solve(solver):
    """As many as the solve took iterations, each with the residual that it had there."""
    whole, steps = falling(solver=solver), falling(solver=solver)
    result = whole.solve()
    for k in range(result.iterations):
        before = values(steps)
        step = steps.newton_step(apply=True)
        assert step.result.residuals == pytest.approx(result.residuals[k : k + 2], rel=1e-6)
        for now, start, change in zip(values(steps), before, step.changes, strict=True):
            np.testing.assert_allclose(now, start + change, rtol=0, atol=1e-15 * E)
    for a, b in zip(values(whole), values(steps), strict=True):
        assert global_norm(COMM, a - b) < 1e-9 * global_norm(COMM, a)
    # From the solution: a step there is, but it is as small as what the last one left.
    (largest, *_) = steps.newton_step().changes
    assert 0.0 < global_norm(COMM, largest) < 1e-9


def test_a_step_that_is_not_applied_leaves_no_trace():
    problem, other = falling(), falling()
    start = values(problem)
    problem.newton_step()
    for now, before in zip(values(problem), start, strict=True):
        np.testing.assert_array_equal(now, before)
    assert problem.solve().residuals == other.solve().residuals


# Forces without a potential


def under_pressure(formulation, d, p, **choices):
    """The top of a clamped beam under a pressure that follows it, solved."""
    body = box(COMM, (2.0, 0.5, 0.5)[:d], (8, 2, 2)[:d])
    loads, motions = [Pressure(p, TOP)], [Fixed(LEFT)]
    model = Model(body, formulation, StableNeoHookean(1e4, NU), loads=loads, motions=motions)
    scheme = Static(model.u)
    work = model.virtual_work(scheme)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, work=work, **choices)
    result = problem.solve()
    return problem, result, model


@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
@pytest.mark.parametrize("d", [2, 3])
def test_pressure_takes_the_same_steps_with_any_solver(formulation, d):
    """LU of K, GMRES on it, whole system and field splits; quadratically, with the load's part."""
    cg = {"condensed_ksp_type": "gmres", "condensed_pc_type": "gamg", "condensed_ksp_rtol": 1e-9}
    variants = [
        {"solver": "direct"},
        {},
        {"engine": False},
        {"solver": "fieldsplit"},
        {"options": cg},
    ]
    runs = [under_pressure(formulation, d, 20.0, **choices) for choices in variants]
    _, direct, model = runs[0]
    reference = model.u.x.array
    assert COMM.allreduce(np.abs(reference).max(), MPI.MAX) > 0.2  # [m]
    assert direct.iterations <= 8 and direct.residuals[-1] < 1e-3 * direct.residuals[-2]
    for _, result, other in runs[1:]:
        assert abs(result.iterations - direct.iterations) <= 1
        assert global_norm(COMM, other.u.x.array - reference) < 1e-8 * global_norm(COMM, reference)
    K = dense(runs[1][0].condensed.K)
    unsymmetric = np.abs(K - K.T).max()
    assert unsymmetric > 1e-4 * np.abs(K).max()


def test_pressure_balances_with_the_reactions():
    """The force -∫ p cof(F) N on the top is what the clamp bears: global equilibrium."""
    p = 150.0
    _, _, model = under_pressure("symmetric", 2, p)
    u, V = model.u, model.u.function_space
    stress = model.stress(Static(u))
    for i in range(2):
        e = fem.Function(V)
        e.x.array[i::2] = 1.0
        clamped = np.concatenate([bc.dof_indices()[0] for bc in model.bcs])
        e.x.array[np.setdiff1d(np.arange(len(e.x.array)), clamped)] = 0.0
        reaction = fem.assemble_scalar(fem.form(ufl.inner(stress, ufl.grad(e)) * ufl.dx))
        normal = ufl.cofac(ufl.Identity(2) + ufl.grad(u)) * ufl.FacetNormal(model.body.mesh)
        pushed = fem.assemble_scalar(fem.form(-p * normal[i] * model.body.ds(TOP)))
        reaction, pushed = (COMM.allreduce(float(f)) for f in (reaction, pushed))
        # The work of the pressure on the clamped vertices goes into the clamp directly.
        own = fem.assemble_scalar(fem.form(-p * ufl.inner(normal, e) * model.body.ds(TOP)))
        assert reaction - COMM.allreduce(float(own)) == pytest.approx(-pushed, rel=1e-8)
        assert abs(pushed) > 50.0


def test_small_pressure_bends_a_beam():
    """An eighth of q L⁴/(E I), plane strain and shear included, by quadratic elements."""
    length, height, modulus, p = 8.0, 0.5, 1e6, 0.1
    body = box(COMM, (length, height), (32, 2), "quadrilateral")
    model = Model(
        body,
        "symmetric",
        Corotational(modulus, 0.0),
        loads=[Pressure(p, TOP)],
        motions=[Fixed(LEFT)],
        degree=2,
    )
    scheme = Static(model.u)
    work = model.virtual_work(scheme)
    MixedProblem(model.energy(scheme), model.fields, model.bcs, work=work).solve()
    inertia = height**3 / 12
    expected = p * length**4 / (8 * modulus * inertia)
    expected += p * length**2 / (2 * (5 / 6) * (modulus / 2) * height)  # Timoshenko
    found = COMM.allreduce(np.abs(model.u.x.array).max(), MPI.MAX)
    assert found == pytest.approx(expected, rel=5e-3)


def test_a_work_that_is_none_is_refused():
    u, S, Y = mixed_fields(small_mesh(2))
    energy = symmetric(u, S, Y, StableNeoHookean(E, NU)) * ufl.dx
    v, w = ufl.TestFunction(u.function_space), ufl.TestFunction(S.function_space)
    for work, choices, message in (
        (ufl.inner(S, w) * ufl.dx, {}, "the work must be linear in a test function of u"),
        (v[0] * ufl.dx, {"globalisation": "projected-newton"}, "the displacement alone as field"),
        (v[0] * ufl.dx, {"globalisation": "none"}, "globalisation is 'none'; available: watchdog"),
        (S[0, 0] * v[0] * ufl.dx, {}, 'the work depends on S; choose solver="direct"'),
        (
            v[0] * ufl.dx,
            {"solver": "fieldsplit", "preconditioner": "block-diagonal-gamg"},
            "'block-diagonal-gamg' needs a problem without work",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            MixedProblem(energy, (u, S, Y), work=work, **choices)


# Conditions


@pytest.mark.parametrize("solver", SOLVERS)
def test_conditions_on_other_spaces_are_refused(solver):
    msh = small_mesh(2)
    u = displacement_field(msh)
    energy = ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx
    own, other = fem.functionspace(msh, ("P", 1, (2,))), small_mesh(2)
    elsewhere = fem.functionspace(other, ("P", 1, (2,)))
    for V, what in ((own, "of no field"), (elsewhere, "of another mesh")):
        bc = fem.dirichletbc(np.zeros(2), np.array([0], dtype=np.int32), V)
        message = f"^Dirichlet condition 1 is on a function space {what}; make it on u.function"
        good = fem.dirichletbc(np.zeros(2), np.array([0], dtype=np.int32), u.function_space)
        with pytest.raises(ValueError, match=message):
            MixedProblem(energy, (u,), [good, bc], solver=solver)


@pytest.mark.parametrize("solver", SOLVERS)
def test_conditions_on_components_count(solver):
    """On a subspace of the displacement's."""
    msh = mesh.create_unit_square(COMM, 2, 2)
    u = displacement_field(msh)
    V = u.function_space
    facets = mesh.locate_entities_boundary(msh, 1, lambda X: np.isclose(X[0], 0.0))
    bcs = [
        fem.dirichletbc(value, fem.locate_dofs_topological(V.sub(i), 1, facets), V.sub(i))
        for i, value in enumerate((0.0, 0.25))
    ]
    MixedProblem(ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx, (u,), bcs, solver=solver).solve()
    np.testing.assert_allclose(u.x.array.reshape(-1, 2) - [0.0, 0.25], 0.0, atol=1e-13)


def test_conditions_on_cell_local_fields_are_refused():
    """Two of them may have one space, so that it is not said which is meant."""
    u, S, Y = mixed_fields(small_mesh(2))
    energy = symmetric(u, S, Y, StableNeoHookean(E, NU)) * ufl.dx
    bc = fem.dirichletbc(fem.Function(S.function_space), np.array([0], dtype=np.int32))
    with pytest.raises(ValueError, match=r"of the cell-local field S; make it on u\.function"):
        MixedProblem(energy, (u, S, Y), [bc])


# Options


def test_options_by_a_name_of_ones_own():
    """What the command line has under it counts, and two problems cannot both have it."""
    PETSc.Options()["bar_snes_max_it"] = 1
    try:
        problem = falling(prefix="bar_", options={"snes_max_it": 30})
        with pytest.raises(ConvergenceError, match="DIVERGED_MAX_IT"):
            problem.solve()
        with pytest.raises(ValueError, match="the options prefix 'bar_' belongs to another"):
            falling(prefix="bar_")
        del problem
        falling(prefix="bar_")
        assert "bar_snes_rtol" not in PETSc.Options().getAll()
    finally:
        PETSc.Options().delValue("bar_snes_max_it")


def test_a_prefix_in_vain_is_free_again():
    u = displacement_field(small_mesh(2))
    with pytest.raises(ValueError, match="the line search"):
        falling(prefix="bar_", options={"snes_linesearch_type": "bt"})
    MixedProblem(ufl.inner(u, u) * ufl.dx, (u,), prefix="bar_").solve()


def test_the_users_absolute_tolerance_counts():
    loose, tight = falling(options={"snes_atol": 1e-3}), falling()
    result = loose.solve()
    assert result.reason == "CONVERGED_FNORM_ABS" and result.residuals[-1] > 1e-9
    assert result.iterations < tight.solve().iterations


def test_what_is_held_stays_in_place_whatever_the_linear_solver():
    """Errors of conjugate gradients do not move a clamped vertex."""
    cg = {"condensed_ksp_type": "cg", "condensed_pc_type": "gamg"}
    problem = falling("symmetric", options=cg)
    assert problem.solve().krylov_iterations > 10
    u = problem.fields[0]
    held = u.function_space.tabulate_dof_coordinates()[:, 0] < 0.2
    np.testing.assert_array_equal(u.x.array.reshape(-1, 2)[held], 0.0)
