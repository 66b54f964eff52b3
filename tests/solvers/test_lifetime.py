"""What a problem leaves behind: nothing, or studies would run out of communicators."""

from __future__ import annotations

import gc
import weakref

from mpi4py import MPI

import pytest

from demos.studies.bar import bar
from solvers.lifetime import destroy_dead
from tests.solvers.test_condensation import build


def left_by(solve):
    """Communicators that a solve leaves behind, the first one of its kind aside."""
    left = []
    for _ in range(2):
        alive = solve()
        gc.collect()
        destroy_dead(MPI.COMM_WORLD)
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
    [("symmetric", None, "down the energy"), ("displacement", "project-on-demand", "projected")],
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
