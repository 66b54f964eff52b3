"""The same Newton iterations and the same positions on 1, 2 and 3 ranks."""

from __future__ import annotations

import json

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from demos.studies.ranks import RanksError, on_ranks
from forms import BackwardEuler, StableNeoHookean, mixed_fields, symmetric
from meshes import Where, box
from solvers import MixedProblem, march

pytestmark = pytest.mark.serial

SOLVERS = {"condensed": {}, "fieldsplit": {"preconditioner": "schur-full-mumps"}}
TIMEOUT = 120.0  # [s]


def worker():
    """Two steps of a falling bar with each solver; rank 0 prints what comes of it."""
    comm, answers = MPI.COMM_WORLD, {}
    for solver, choices in SOLVERS.items():
        body = box(comm, size=(2.0, 1.0), cells=(8, 4))
        u, S, Y = mixed_fields(body.mesh)
        euler = BackwardEuler(u, 0.2, (0.0, -9.81))
        V, psi = u.function_space, StableNeoHookean(10.0, 0.3)
        energy = symmetric(u, S, Y, psi) * ufl.dx + euler.kinetic(2.0) * ufl.dx
        clamped = fem.dirichletbc(np.zeros(2), body.dofs(V, Where(extents=(("x", "min"),))), V)
        problem = MixedProblem(energy, (u, S, Y), [clamped], solver=solver, **choices)
        iterations = [result.iterations for result in march(problem, euler, 2)]
        positions = body.gather_points(everywhere=True) + body.gather(u, everywhere=True)
        answers[solver] = {"iterations": iterations, "positions": positions.tolist()}
    if comm.rank == 0:
        print(json.dumps(answers))


def test_any_number_of_ranks_gives_the_same():
    code = "from tests.solvers.test_sameness import worker; worker()"
    one, *others = (json.loads(on_ranks(p, code, timeout=TIMEOUT)) for p in (1, 2, 3))
    for solver in SOLVERS:
        expected = np.array(one[solver]["positions"])
        assert np.abs(expected - np.array(one["condensed"]["positions"])).max() < 1e-10
        assert len(expected) == 9 * 5 and np.ptp(expected[:, 1]) > 1.2  # it has fallen far
        for other in others:
            assert other[solver]["iterations"] == one[solver]["iterations"]
            np.testing.assert_allclose(other[solver]["positions"], expected, rtol=0, atol=1e-10)


def test_ranks_that_fail_or_hang_are_ended():
    with pytest.raises(RanksError, match=r"2 ranks failed: .*"):
        on_ranks(2, "raise SystemExit('this will not do')", timeout=TIMEOUT)
    with pytest.raises(RanksError, match="2 ranks were not done after 3 s"):
        on_ranks(2, "import time; time.sleep(1000.0)", timeout=3.0)
