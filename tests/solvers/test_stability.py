"""Unstable states and bodies that nothing holds are told by name."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scipy.sparse import csr_matrix

from forms import BackwardEuler, Fixed, Gravity, Model, StableNeoHookean, Static, Translate
from meshes import Where, box
from solvers import ConvergenceError, MixedProblem

COMM = MPI.COMM_WORLD
LEFT, RIGHT, BELOW = (Where(extents=(end,)) for end in (("x", "min"), ("x", "max"), ("y", "min")))
CORNER = Where(extents=(("x", "min"), ("y", "min")))
LENGTH = 10.0
KEEPS = "keeps the body from"


def strut(formulation, *, motions, loads=(), scheme=Static, solver="condensed", **keys):
    """A strip ten times as long as wide, and its problem."""
    body = box(COMM, size=(LENGTH, 1.0), cells=(20, 2))
    psi = StableNeoHookean(1e4, 0.3)
    model = Model(body, formulation, psi, rho=1.0, loads=list(loads), motions=list(motions))
    scheme = scheme(model.u, **({"h": 1.0} if scheme is BackwardEuler else {}))
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, solver=solver, **keys)
    model.update(scheme)
    return model, scheme, problem


def eigenvalues(K):
    """All of a distributed matrix."""
    parts = COMM.allgather(K.getValuesCSR())
    rows = [csr_matrix((v, c, p), shape=(len(p) - 1, K.size[1])).toarray() for p, c, v in parts]
    return np.linalg.eigvalsh(np.vstack(rows))


@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
def test_a_straight_strut_beyond_its_buckling_load(formulation):
    """It converges to the straight state, whose negative eigenvalues are counted."""
    # Clamped at both ends a slender one buckles at a strain of 4π² I/(A L²) = 0.033.
    push = Translate(RIGHT, lambda t: (-t, 0.0))
    model, scheme, problem = strut(formulation, motions=[Fixed(LEFT), push])
    counts = {}
    for strain in (0.01, 0.08, 0.12):
        scheme.t = strain * LENGTH - 1.0
        model.update(scheme)  # to the end of a step of 1 s
        result = problem.solve()
        negative = np.sum(eigenvalues(problem.condensed.K) < 0.0)
        said = {0: "", 1: "1 negative eigenvalue"}.get(negative, f"{negative} negative eigenvalues")
        assert result.unstable == said
        notes = result.notes.get(len(result.residuals) - 1, "")
        assert ("unstable state: " + said in notes) == (negative > 0)
        counts[strain] = negative
    assert counts[0.01] == 0 and 0 < counts[0.08] < counts[0.12]


@pytest.mark.parametrize("solver", ["condensed", "direct"])
@pytest.mark.parametrize(
    ("motions", "free"),
    [
        ([], "moving along x, y and turning about z"),
        ([Fixed(BELOW, components="x")], "moving along y"),
        ([Fixed(LEFT, components="x"), Fixed(RIGHT, components="x")], "moving along y"),
    ],
)
def test_what_nothing_holds_in_statics(motions, free, solver):
    pull = Gravity((0.1, -1.0))
    _, _, problem = strut("symmetric", motions=motions, loads=[pull], solver=solver)
    with pytest.raises(ConvergenceError, match=rf"\(next to nothing {KEEPS} {free}[;)]"):
        problem.solve()


def test_a_hinge():
    """Given the iterations it swings down to where it hangs, else it is said to be free to turn."""
    model, _, problem = strut("symmetric", motions=[Fixed(CORNER)], loads=[Gravity((0.0, -1.0))])
    problem.solve()
    x, _ = center_of_mass(model)
    assert x == pytest.approx(0.0, abs=1e-6)
    _, _, problem = strut(
        "symmetric",
        motions=[Fixed(CORNER)],
        loads=[Gravity((0.0, -1.0))],
        options={"snes_max_it": 1},
    )
    with pytest.raises(ConvergenceError, match=f"next to nothing {KEEPS} turning about z"):
        problem.solve()


def center_of_mass(model):
    """Its present coordinates, by an integral."""
    msh = model.body.mesh
    x = ufl.SpatialCoordinate(msh) + model.u
    parts = [fem.assemble_scalar(fem.form(x[i] * ufl.dx)) for i in range(2)]
    return np.array(COMM.allreduce(np.array(parts))) / LENGTH


def test_inertia_holds():
    """A failure of another cause is not put down to want of support."""
    _, _, problem = strut(
        "symmetric",
        motions=[Fixed(CORNER)],
        loads=[Gravity((0.0, -1.0))],
        scheme=BackwardEuler,
        options={"snes_max_it": 1},
    )
    with pytest.raises(ConvergenceError) as error:
        problem.solve()
    assert "nothing keeps" not in str(error.value)
