"""Static condensation is exact: against the whole block system, and a dense Schur complement."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    deformation_gradient,
    displacement_field,
    measure,
)
from solvers import ConvergenceError, MixedProblem
from solvers.layout import is_local
from solvers.result import history_table
from solvers.strategies.watchdog import Watchdog
from tests.states import (
    FIRST,
    FIRST_FORMULATIONS,
    by_field,
    dense,
    global_norm,
    random_directions,
    random_values,
    small_mesh,
)

MIXED = [name for name in FIRST_FORMULATIONS if name != "displacement"]
E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4
CG = {"condensed_ksp_type": "cg", "condensed_pc_type": "gamg"}


def build(d, formulation, material, solver="condensed", options=None, engine=True):
    """A clamped body at rest."""
    msh = small_mesh(d)
    form = FORMULATIONS[formulation]
    fields = form.fields(msh)
    u = fields[0]
    psi = MATERIALS[material](E, NU)
    energy = BackwardEuler(u, H, (0.0, -9.81, 1.0)[:d]).kinetic(RHO) * ufl.dx
    energy += form.density(*fields, psi) * ufl.dx
    clamped = fem.locate_dofs_geometrical(u.function_space, lambda X: X[0] < 0.2)
    bcs = [fem.dirichletbc(np.zeros(d), clamped, u.function_space)]
    return MixedProblem(energy, fields, bcs, solver=solver, options=options, engine=engine)


def newton_step(problem):
    """Fields after one Newton step from a state far from rest, owned values by field."""
    u, directions = problem.fields[0], random_directions(problem.fields, stress=E)
    clamped = u.function_space.tabulate_dof_coordinates()[:, 0] < 0.2
    directions[0].reshape(-1, len(u))[clamped] = 0.0
    for f, change in zip(problem.fields, directions, strict=True):
        f.x.array[:] += 0.5 * change
    problem.problem.solver.setTolerances(max_it=1)
    problem.problem.solver.setForceIteration(True)
    start = [f.x.array.copy() for f in problem.fields]
    # PETSc calls a single step a failure to converge; the step is in the solution vector.
    with pytest.raises(RuntimeError, match="DIVERGED_MAX_IT"):
        problem.solve()
    for f, values in zip(problem.fields, start, strict=True):
        np.testing.assert_array_equal(f.x.array, values)
    return by_field(problem, problem.problem.x)


@pytest.mark.parametrize(
    ("d", "formulation", "material"), [case for case in FIRST if case[1] in MIXED]
)
def test_same_newton_step_as_the_whole_system(d, formulation, material):
    steps = [newton_step(build(d, formulation, material, s)) for s in ("direct", "condensed")]
    for whole, condensed in zip(*steps, strict=True):
        difference = global_norm(MPI.COMM_WORLD, whole - condensed)
        assert difference < 1e-9 * global_norm(MPI.COMM_WORLD, whole)


@pytest.mark.parametrize(("d", "formulation", "material"), FIRST)
def test_same_newton_step_by_the_engine(d, formulation, material):
    """One switch, same numbers: the engine and UFL take the same step."""
    steps = [newton_step(build(d, formulation, material, engine=e)) for e in (False, True)]
    for by_ufl, by_engine in zip(*steps, strict=True):
        difference = global_norm(MPI.COMM_WORLD, by_ufl - by_engine)
        assert difference < 1e-11 * global_norm(MPI.COMM_WORLD, by_ufl)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_the_engine_converges_to_the_same_state(d, formulation):
    """The same iterations to the same state."""
    results, states = [], []
    for engine in (False, True):
        problem = build(d, formulation, "stable-neo-hookean", engine=engine)
        results.append(problem.solve())
        states.append([f.x.array.copy() for f in problem.fields])
    assert results[0].iterations == results[1].iterations
    for by_ufl, by_engine in zip(*states, strict=True):
        np.testing.assert_allclose(by_engine, by_ufl, rtol=0, atol=1e-9 * np.abs(by_ufl).max())


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("formulation", MIXED)
def test_condensed_matrix_is_the_schur_complement(d, formulation):
    """K = J_uu - J_ul J_ll⁻¹ J_lu, the inverse taken of the whole dense matrix J_ll."""
    whole, problem = (
        build(d, formulation, "stable-neo-hookean", s) for s in ("direct", "condensed")
    )
    for each in (whole, problem):
        newton_step(each)
    A, K = dense(whole.problem.A), dense(problem.condensed.K) / problem.scales[0] ** 2
    comm = MPI.COMM_WORLD
    # Unknowns of u among all: each rank has its own first.
    sizes = [len(part) for part in by_field(whole, whole.problem.x)]
    units = np.concatenate(comm.allgather(np.repeat(whole.scales, sizes)))
    A /= np.outer(units, units)
    is_u = np.concatenate(comm.allgather(np.repeat([True, False], [sizes[0], sum(sizes[1:])])))
    J_uu, J_ul = A[np.ix_(is_u, is_u)], A[np.ix_(is_u, ~is_u)]
    J_lu, J_ll = A[np.ix_(~is_u, is_u)], A[np.ix_(~is_u, ~is_u)]
    schur = J_uu - J_ul @ np.linalg.solve(J_ll, J_lu)
    assert np.linalg.norm(K - schur) < 1e-12 * np.linalg.norm(schur)
    assert np.linalg.norm(K - K.T) < 1e-12 * np.linalg.norm(K)


def test_conjugate_gradients_take_the_same_solution():
    """CG with GAMG in place of the factorisation: the same state in as many Newton steps."""
    states, iterations = [], []
    for options in ({}, CG):
        problem = build(3, "symmetric", "stable-neo-hookean", options=options)
        result = problem.solve()
        states.append(problem.fields[0].x.array.copy())
        iterations.append(result.iterations)
        assert (result.krylov_iterations > result.iterations) == bool(options)
    assert global_norm(MPI.COMM_WORLD, states[0] - states[1]) < 1e-9
    assert 3 <= iterations[1] <= iterations[0] + 1


def pressed(engine, options=None):
    """The step from a state of high pressure, where K is indefinite, and what it noted."""
    problem = build(3, "symmetric", "stable-neo-hookean", options=options, engine=engine)
    Y = problem.fields[2]
    Y.x.array.reshape(-1, 6)[:] = -2.0 * E * np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    problem.problem.solver.setTolerances(max_it=1)
    with pytest.raises(ConvergenceError, match="DIVERGED_MAX_IT") as error:
        problem.solve()
    result = error.value.result
    if result.notes:
        assert result.notes[1] in history_table(result).splitlines()[-1]
    K = dense(problem.condensed.K)
    return by_field(problem, problem.problem.x), result.notes, np.linalg.eigvalsh(K)[0]


def test_negative_curvature_without_the_engine():
    """CG meets it, and LDLᵀ takes the same step as it does from the start."""
    exact, notes, lowest = pressed(engine=False)
    assert notes == {} and lowest < 0.0
    step, notes, _ = pressed(engine=False, options=CG)
    assert notes == {1: "negative curvature: LDLᵀ"}
    for a, b in zip(exact, step, strict=True):
        difference = global_norm(MPI.COMM_WORLD, a - b)
        assert difference < 1e-9 * global_norm(MPI.COMM_WORLD, a)


def test_negative_curvature_with_the_engine():
    """CG meets it, and takes the step of the projected tangent, which is positive definite."""
    exact, notes, lowest = pressed(engine=True)
    assert notes == {} and lowest < 0.0
    step, notes, lowest = pressed(engine=True, options=CG)
    assert notes == {1: "negative curvature: projected tangent"} and lowest > 0.0
    difference = global_norm(MPI.COMM_WORLD, exact[0] - step[0])
    assert difference > 0.1 * global_norm(MPI.COMM_WORLD, step[0])


def falling(formulation, E, h, **options):
    """A soft clamped bar in a large step under gravity, where full Newton steps diverge."""
    msh = mesh.create_box(MPI.COMM_WORLD, [(0, 0, 0), (4, 1, 1)], [12, 3, 3])
    form = FORMULATIONS[formulation]
    fields = form.fields(msh)
    V = fields[0].function_space
    psi = MATERIALS["stable-neo-hookean"](E, 0.45)
    kinetic = BackwardEuler(fields[0], h, (0.0, -9.81, 0.0)).kinetic(1000.0) * ufl.dx
    clamped = fem.locate_dofs_geometrical(V, lambda X: np.isclose(X[0], 0.0))
    bcs = [fem.dirichletbc(np.zeros(3), clamped, V)]
    return MixedProblem(form.density(*fields, psi) * ufl.dx + kinetic, fields, bcs, **options)


@pytest.mark.parametrize("engine", [False, True])
def test_a_line_search_takes_over_where_full_steps_diverge(engine):
    """Every solve of the seed's energy below ends where the displacement's Newton ends."""
    mixed = falling("symmetric", 1e5, 1.0, engine=engine)
    result = mixed.solve()
    restart = [k for k, note in result.notes.items() if "full steps diverge" in note]
    assert len(restart) == 1 and 1 < restart[0] < result.iterations
    assert len(result.residuals) == len(result.norms) == result.iterations + 1
    assert max(result.residuals[: restart[0]]) > 100 * result.residuals[0]
    assert "full steps diverge" in history_table(result)
    classical = falling("displacement", 1e5, 1.0, engine=engine)
    classical.solve()
    u, v = (problem.fields[0].x.array for problem in (mixed, classical))
    assert global_norm(MPI.COMM_WORLD, u - v) < 1e-7 * global_norm(MPI.COMM_WORLD, v)
    # The next solve tries full steps again.
    assert falling("symmetric", 1e7, 0.1, engine=engine).solve().notes == {}


def test_projected_newton_reaches_the_same_state():
    """A descent on the energy to its minimum, by other steps than the exact tangent's."""
    states, iterations = [], []
    for globalisation in (None, "projected-newton"):
        problem = falling("displacement", 1e6, 0.1, globalisation=globalisation)
        iterations.append(problem.solve().iterations)
        states.append(problem.fields[0].x.array.copy())
    difference = global_norm(MPI.COMM_WORLD, states[0] - states[1])
    assert difference < 1e-8 * global_norm(MPI.COMM_WORLD, states[0])
    assert iterations[0] != iterations[1]


class Down(Watchdog):
    """The last resort at once, where full steps diverge."""

    def _search(self):
        return False

    def _part_by_part(self):
        self.newton.restart("from the start again")
        return False


@pytest.mark.parametrize("formulation", ["symmetric", "seed"])
def test_down_the_energy_where_residuals_lead_nowhere(formulation):
    """A bar that its weight draws far out: no step goes up, and the end is the displacement's."""
    problem = falling(formulation, 1e3, 1.0, globalisation=Down())
    result = problem.solve()
    assert any("down the energy" in note for note in result.notes.values())
    assert any("projected tangent" in note for note in result.notes.values())
    u, energy = problem.fields[0].x.array.copy(), problem.system.energy()
    alone = falling("displacement", 1e3, 1.0)
    alone.fields[0].x.array[:] = u
    assert alone.system.energy() == pytest.approx(energy, rel=1e-9)
    alone.solve()
    difference = global_norm(MPI.COMM_WORLD, u - alone.fields[0].x.array)
    assert difference < 1e-6 * global_norm(MPI.COMM_WORLD, u)


@pytest.mark.parametrize("engine", [False, True])
def test_part_by_part_where_full_steps_diverge(engine):
    """The weight is let in first in eighths; the end is the displacement's."""
    parts = falling("symmetric", 1e5, 1.0, engine=engine, globalisation="continuation")
    result = parts.solve()
    notes = [note for note in result.notes.values() if "of the whole" in note]
    assert "0.125 of the whole" in notes[0] and "1 of the whole" in notes[-1]
    classical = falling("displacement", 1e5, 1.0, engine=engine)
    classical.solve()
    u, v = (problem.fields[0].x.array for problem in (parts, classical))
    assert global_norm(MPI.COMM_WORLD, u - v) < 1e-7 * global_norm(MPI.COMM_WORLD, v)


def test_relaxed_fields_are_where_the_energy_is_stationary():
    """From a state far away, for every formulation: S(F) and the stress that belongs to it."""
    msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (1, 1)], [2, 2])
    rng = np.random.default_rng(3)
    for name, form in FORMULATIONS.items():
        fields = form.fields(msh)
        psi = MATERIALS["stable-neo-hookean"](1e5, 0.3)
        problem = MixedProblem(form.density(*fields, psi) * measure(fields[0]), fields)
        fields[0].x.array[:] = 0.02 * rng.standard_normal(fields[0].x.array.size)
        fields[0].x.scatter_forward()
        system = problem.system
        assert system.relax(), name
        system.residual(system.b)
        parts = system.layout.split(system.b.array_r)
        norms = [global_norm(MPI.COMM_WORLD, r) for r in parts]
        local = [norm for f, norm in zip(fields, norms, strict=True) if is_local(f)]
        assert not local or max(local) < 1e-9 * norms[0], name


@pytest.mark.parametrize(
    ("formulation", "options", "message"),
    [
        (
            "displacement",
            {"globalisation": "projected-newton", "engine": False},
            "'projected-newton' goes down on the energy: it needs the engine",
        ),
        (
            "symmetric",
            {"globalisation": "projected-newton"},
            "'projected-newton' needs the displacement alone as field",
        ),
        ("symmetric", {"options": {"snes_linesearch_type": "bt"}}, 'choose "l2" or "cp"'),
        ("symmetric", {"options": {"ksp_type": "gmres"}}, "name the condensed system's"),
        ("symmetric", {"options": {"condensed_pc_type": "icc"}}, "add condensed_ksp_type=cg"),
    ],
)
def test_what_does_not_go_together_is_refused(formulation, options, message):
    with pytest.raises(ValueError, match=message):
        falling(formulation, 1e7, 0.1, **options)


def test_an_energy_of_ones_own():
    """Pressure and volume ratio as cell-local fields (Simo, Taylor, Pister 1985), unknown here."""
    states = []
    for solver in ("direct", "condensed"):
        msh = small_mesh(3)
        u = displacement_field(msh)
        dg0 = fem.functionspace(msh, ("DG", 0))
        p, theta = fem.Function(dg0, name="p"), fem.Function(dg0, name="theta")
        theta.x.array[:] = 1.0
        F = deformation_gradient(u)
        J = ufl.det(F)
        density = (
            E / 2 * (J ** (-2 / 3) * ufl.inner(F, F) - 3)
            + 500 * E * (theta - 1) ** 2
            + p * (J - theta)
        )
        V = u.function_space
        clamped = fem.locate_dofs_geometrical(V, lambda X: X[0] < 0.2)
        load = ufl.inner(u, ufl.as_vector((0.0, -0.3, 0.2))) * ufl.dx
        problem = MixedProblem(
            density * ufl.dx - load,
            (u, p, theta),
            [fem.dirichletbc(np.zeros(3), clamped, V)],
            solver=solver,
        )
        problem.solve()
        states.append([f.x.array.copy() for f in (u, p, theta)])
    for whole, condensed in zip(*states, strict=True):
        assert global_norm(MPI.COMM_WORLD, whole - condensed) < 1e-9 * (
            1.0 + global_norm(MPI.COMM_WORLD, whole)
        )
    assert global_norm(MPI.COMM_WORLD, states[0][0]) > 1e-3


def test_a_field_that_is_not_local_is_refused():
    msh = small_mesh(2)
    u = displacement_field(msh)
    p = fem.Function(fem.functionspace(msh, ("P", 1)), name="p")
    u.x.array[:] = 0.1 * random_values(u, 1)
    energy = (ufl.inner(ufl.grad(u), ufl.grad(u)) + ufl.inner(u, u) + p**2 + p * u[0]) * ufl.dx
    with pytest.raises(ValueError, match="the field p is not local to cells"):
        MixedProblem(energy, (u, p), solver="condensed", engine=False)
