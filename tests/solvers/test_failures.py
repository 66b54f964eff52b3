"""What a solve does that cannot be done: it raises, and the next one may succeed."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from demos.studies.bar import bar
from forms import (
    BackwardEuler,
    deformation_gradient,
    displacement_field,
    mixed_fields,
    right_stretch,
)
from solvers import ConvergenceError, MixedProblem
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
