"""What a solve does that cannot be done: it raises, and the next one may succeed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from demos.studies.bar import bar
from forms import (
    BackwardEuler,
    Fixed,
    Gravity,
    History,
    Model,
    Prescribed,
    StableNeoHookean,
    deformation_gradient,
    displacement_field,
    mixed_fields,
    point_field,
    right_stretch,
)
from meshes import Where, box
from solvers import SOLVERS, ConvergenceError, MixedProblem, march
from tests.bodies import largest
from tests.states import small_mesh

COMM = MPI.COMM_WORLD


def local(msh, name):
    return fem.Function(fem.functionspace(msh, ("DG", 0)), name=name)


@pytest.mark.parametrize("cells", ["all", "one"])
def test_a_singular_local_block_is_named(cells):
    """A pressure without compliance: p and the part of Y that balances it are undetermined."""
    msh = small_mesh(2)
    u, S, Y = mixed_fields(msh)
    p, compliance = local(msh, "p"), local(msh, "compliance")
    where = msh.topology.original_cell_index[: len(compliance.x.array)]
    compliance.x.array[:] = 0.0 if cells == "all" else np.where(where == 3, 0.0, 0.1)
    J, load = ufl.det(S), BackwardEuler(u, 0.4, (0.0, -9.81)).kinetic(2.0)
    psi = 1.5 * (ufl.inner(S, S) - 2) - 3.0 * (J - 1) + p * (J - 1) - compliance / 2 * p**2
    energy = (psi - ufl.inner(Y, S - right_stretch(deformation_gradient(u))) + load) * ufl.dx
    problem = MixedProblem(energy, (u, S, Y, p))
    for _ in range(2):
        with pytest.raises(ConvergenceError, match="the local block of Y, p is singular") as error:
            problem.solve()
        assert len(error.value.result.residuals) == 1
    compliance.x.array[:] = 0.1
    assert problem.solve().iterations > 0


@pytest.mark.parametrize("solver", ["direct", "fieldsplit", "condensed"])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_failed_factorisation_is_reported(solver, mixed):
    """An energy that does not hold u_y, then does: MUMPS begins anew after a failure."""
    msh = small_mesh(2)
    u = displacement_field(msh)
    fields, hold = (u,), fem.Constant(msh, 0.0)
    density = u[0] ** 2 + u[0] + hold * (u[1] ** 2 - 4 * u[1])
    if mixed:
        fields = u, p = u, local(msh, "p")
        density += p**2 + p * u[0]
    problem = MixedProblem(density * ufl.dx, fields, solver=solver)
    for _ in range(2):
        with pytest.raises(ConvergenceError, match="FACTOR_NUMERIC_ZEROPIVOT") as error:
            problem.solve()
        assert set(error.value.result.norms[0]) == {f.name for f in fields}
    hold.value = 1.0
    problem.solve()
    np.testing.assert_allclose(u.x.array[1::2], 2.0, rtol=1e-12)


@pytest.mark.parametrize("solver", ["direct", "condensed"])
def test_a_start_that_is_no_state_is_reported(solver):
    msh = small_mesh(2)
    u = displacement_field(msh)
    u.x.array[:] = np.nan
    problem = MixedProblem(ufl.inner(u, u) * ufl.dx, (u,), solver=solver)
    with pytest.raises(ConvergenceError, match="DIVERGED_FUNCTION_NANORINF"):
        problem.solve()


BT = {"snes_linesearch_type": "bt"}


def test_a_line_search_that_gets_nowhere_has_not_converged():
    """However small the residual: here it is that of a thrown bar of very stiff and soft parts."""
    run = bar(COMM, "displacement", n=3, E=1e6, contrast=1e9, h=1.0, support="free", options=BT)
    run.step()
    (result,) = run.results
    assert result.residuals[-1] > 0.9 * result.residuals[0]
    assert run.failure == result.reason and result.reason.startswith("DIVERGED_LINE_SEARCH")


def test_a_search_in_vain_is_not_made_again_at_once():
    """A collapsing bar of soft and stiff parts, which all other methods give up."""
    run = bar(COMM, "symmetric", n=3, E=1e3, contrast=1e6, h=1.0)
    run.step()
    run.step()
    assert not run.failure
    first, second = (" ".join(result.notes.values()) for result in run.results)
    assert "line search" in first and "part by part" in first
    assert "line search" not in second and "part by part" in second
    assert run.problem.carried()["iterations"] == run.results[1].iterations


def thrown(formulation, contrast):
    """A bar that is all but rigid, after a step."""
    run = bar(COMM, formulation, n=3, E=1e12, contrast=contrast, h=1.0, support="free")
    run.step()
    return run


@pytest.mark.parametrize(("formulation", "error"), [("displacement", 1e-2), ("symmetric", 1e-5)])
def test_inertia_beside_a_stiffness_1e12_times_as_large_is_balanced(formulation, error):
    """Rounding error of positions is a force in the one, and in the other only in S(F) = S."""
    u, v = (thrown(formulation, contrast).model.u.x.array for contrast in (1.0, 1e3))
    assert largest(u - v) < error * largest(u)


def test_what_does_not_fit_double_precision_is_not_solved():
    """With 1e15 times inertia is lost in rounding error, where no residual shows it any more."""
    run = thrown("displacement", 1e6)
    assert "do not fit double precision" in run.failure


def held(solver="condensed", load=None, histories=()):
    """A bar that falls, by Model, and its parts."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    model = Model(
        body,
        "symmetric",
        StableNeoHookean(1e5, 0.3),
        rho=1000.0,
        loads=[Gravity(load or (0.0, -1.0))],
        motions=[Fixed(Where(extents=(("x", "min"),)))],
        histories=histories,
    )
    scheme = BackwardEuler(model.u, 0.1)
    return MixedProblem(model.energy(scheme), model.fields, model.bcs, solver=solver), scheme, model


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_is_no_number_is_named(solver):
    """Field and cell, whether a load, a motion or the state is at fault; nothing has changed."""
    problem, scheme, model = held(solver, lambda t: (0.0, np.nan if t > 0.15 else -1.0))
    list(march(problem, scheme, 1, model))
    before = model.u.x.array.copy()
    with pytest.raises(ConvergenceError, match=r"no finite residual of u in cell 0 \(from 0\)"):
        list(march(problem, scheme, 1, model))
    np.testing.assert_array_equal(model.u.x.array, before)
    assert scheme.t == pytest.approx(0.1)

    problem, scheme, model = held(solver)
    stretches = model.fields[1].function_space.dofmap
    here = model.body.mesh.topology.original_cell_index == 5
    for block in stretches.list[here, 0]:
        model.fields[1].x.array[3 * block] = np.inf
    with pytest.raises(ConvergenceError, match=r"no finite residual of [SY] in cell 5 "):
        problem.solve()


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_motion_that_is_no_number_is_named(solver):
    body = box(COMM, (2.0, 1.0), (4, 2))
    shaken = Prescribed(Where(extents=(("x", "min"),)), lambda X, t: np.full_like(X, np.nan))
    model = Model(body, "symmetric", StableNeoHookean(1e5, 0.3), rho=1.0, motions=[shaken])
    scheme = BackwardEuler(model.u, 0.1)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, solver=solver)
    with pytest.raises(ConvergenceError, match="no finite residual of"):
        list(march(problem, scheme, 1, model))
    assert np.isfinite(model.u.x.array).all()


def test_a_history_that_is_no_number_is_named():
    problem, scheme, model = held()
    alpha = point_field(model.body.mesh, 0.0, name="alpha")
    numbers = model.body.mesh.topology.original_cell_index
    model.histories.append(
        History(alpha, alpha + 1.0, lambda values: np.where(numbers == 7, np.nan, values))
    )
    with pytest.raises(FloatingPointError, match="variable alpha is not finite in cell 7"):
        list(march(problem, scheme, 1, model))
    assert scheme.t == 0.0 and np.isfinite(alpha.x.array).all()


def test_fields_of_another_mesh_are_refused():
    problem, _, model = held()
    other = mixed_fields(box(COMM, (2.0, 1.0), (4, 2)).mesh)[0]
    other.name = "w"
    energy = ufl.inner(model.u, model.u) * ufl.dx(domain=model.body.mesh)
    with pytest.raises(ValueError, match="w is on another mesh than u"):
        MixedProblem(energy + other**2 * ufl.dx(domain=model.body.mesh), (model.u,))
    assert problem.solve().iterations > 0


def test_a_negative_number_of_steps_is_refused():
    problem, scheme, model = held()
    with pytest.raises(ValueError, match="steps is -1; it must be a whole number of 0 or more"):
        list(march(problem, scheme, -1, model))


TWO_HUNDRED = """
import numpy as np
from tests.solvers.test_failures import held
kept = [held() for _ in range(200)]
for problem, *_ in kept:
    problem.solve()
first, last = kept[0][2].u.x.array, kept[-1][2].u.x.array
np.testing.assert_allclose(first, last, atol=1e-14)
kept[0][0].solve()  # its factors had to make room
np.testing.assert_allclose(first, last, atol=1e-12)
print("all at once")
"""


@pytest.mark.serial
def test_two_hundred_problems_at_once():
    """Each with a mesh of its own, in a process of their own: MPICH has 2048 communicators."""
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", TWO_HUNDRED], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.stdout == "all at once\n", done.stderr
