"""What a problem leaves behind: nothing, or studies would run out of communicators."""

from __future__ import annotations

import gc
import weakref

from mpi4py import MPI

import pytest

from demos.studies.bar import bar
from meshes import box
from solvers import lifetime
from solvers.lifetime import destroy_dead
from tests.solvers.test_condensation import build


def clear():
    gc.collect()
    destroy_dead(MPI.COMM_WORLD)


def left_by(solve):
    """Communicators that a solve leaves behind, the first one of its kind aside."""
    left = []
    clear()  # of what other tests have left
    for _ in range(2):
        alive = solve()
        clear()
        assert [reference() for reference in alive] == [None] * len(alive)
        left.append(free_communicators())
    return left[0] - left[1]


def free_communicators():
    """How many more communicators MPICH can make, on every rank; 0 with another MPI."""
    if MPI.get_vendor()[0] != "MPICH":
        return 0
    made = []
    handler = MPI.COMM_WORLD.Get_errhandler()
    MPI.COMM_WORLD.Set_errhandler(MPI.ERRORS_RETURN)
    try:
        while True:
            made.append(MPI.COMM_WORLD.Dup())
    except MPI.Exception:
        pass
    finally:
        MPI.COMM_WORLD.Set_errhandler(handler)
    for comm in made:
        comm.Free()
    return len(made)


@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
@pytest.mark.parametrize(
    ("solver", "engine"),
    [("direct", False), ("fieldsplit", False), ("condensed", False), ("condensed", True)],
)
def test_a_problem_is_freed(formulation, solver, engine):
    """With its mesh and PETSc's objects, which hold communicators: there are only so many."""

    def solve():
        problem = build(2, formulation, "stable-neo-hookean", solver, engine=engine)
        problem.solve()
        mesh = problem.fields[0].function_space.mesh
        return [weakref.ref(thing) for thing in (problem, problem.problem, mesh)]

    assert left_by(solve) == 0


@pytest.mark.parametrize(
    ("formulation", "globalisation", "note"),
    [("symmetric", None, "part by part"), ("displacement", "project-on-demand", "projected")],
)
def test_a_descent_is_freed(formulation, globalisation, note):
    """With the vectors it works with."""

    def solve():
        run = bar(
            MPI.COMM_WORLD, formulation, n=3, E=1e3, h=1.0, dimension=2, globalisation=globalisation
        )
        run.step()
        assert any(note in text for text in run.results[0].notes.values())
        return [weakref.ref(run.problem)]

    assert left_by(solve) == 0


@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
@pytest.mark.parametrize("solver", ["direct", "fieldsplit", "condensed"])
def test_problems_on_one_mesh_share_its_communicators(monkeypatch, formulation, solver):
    """Beyond those whose factors are kept, ten more problems alive take fewer than one each."""
    monkeypatch.setattr(lifetime, "MOST_FACTORS", 4)
    body = box(MPI.COMM_WORLD, size=(2.0, 1.0), cells=(2, 1))
    alive, left = [], []
    clear()
    for _ in range(15):
        run = bar(
            MPI.COMM_WORLD, formulation, n=1, E=1e5, h=0.1, dimension=2, solver=solver, body=body
        )
        run.step()
        alive.append(run)
        left.append(free_communicators())
    assert left[4] - left[-1] < 10
    alive[0].step()  # its factors are gone


def test_too_many_problems_are_refused(monkeypatch):
    """In Python, before MPI aborts."""
    if not free_communicators():
        pytest.skip("another MPI has more communicators than there is memory for")
    monkeypatch.setattr(lifetime, "SPARE", 3000)
    with pytest.raises(RuntimeError, match=r"fewer than .* communicators left.* share a mesh"):
        bar(MPI.COMM_WORLD, "displacement", n=1, E=1e5, h=0.1, dimension=2)
