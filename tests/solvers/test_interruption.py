"""Signals and errors in the middle of a solve: kept until PETSc has returned."""

from __future__ import annotations

import signal
import threading

from mpi4py import MPI

import numpy as np
import pytest

from forms import BackwardEuler, Fixed, Gravity, Model, StableNeoHookean
from meshes import Where, box
from solvers import SOLVERS, STRATEGIES, MixedProblem, deferred, safe_point
from tests.bodies import largest

COMM = MPI.COMM_WORLD
LEFT = Where(extents=(("x", "min"),))


class Stop(Exception):
    """What a handler of the tests raises."""


def falling(formulation="symmetric", **keys):
    model = Model(
        box(COMM, (2.0, 1.0), (4, 2)),
        formulation,
        StableNeoHookean(1e5, 0.3),
        rho=1000.0,
        loads=[Gravity((0.0, -9.81))],
        motions=[Fixed(LEFT)],
    )
    return MixedProblem(model.energy(BackwardEuler(model.u, 0.1)), model.fields, model.bcs, **keys)


def raise_in(problem, number, when):
    """Send this process a signal in the `when`-th evaluation of the residual."""
    system, calls = problem.system, []
    residual = type(system).residual

    def evaluated(b):
        calls.append(1)
        if len(calls) == when:
            signal.raise_signal(number)
        residual(system, b)

    system.residual = evaluated
    return calls


@pytest.fixture
def handler(monkeypatch):
    """SIGUSR1 raises `Stop` for as long as a test runs."""

    def stop(number, frame):
        raise Stop

    before = signal.signal(signal.SIGUSR1, stop)
    yield stop
    signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("when", [1, 2])
def test_an_interrupt_leaves_the_problem_alive(solver, when, handler):
    """What the handler raises comes out; the fields are as before; the next solve is as ever."""
    untouched, problem = falling(solver=solver), falling(solver=solver)
    untouched.solve()
    before = [f.x.array.copy() for f in problem.fields]
    raise_in(problem, signal.SIGUSR1, when)
    with pytest.raises(Stop):
        problem.solve()
    for f, values in zip(problem.fields, before, strict=True):
        np.testing.assert_array_equal(f.x.array, values)
    assert signal.getsignal(signal.SIGUSR1) is handler
    result = problem.solve()
    assert result.iterations > 1
    assert largest(problem.fields[0].x.array - untouched.fields[0].x.array) < 1e-12


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_strategies_forget_an_interrupted_solve(strategy, handler):
    formulation = "symmetric" if strategy in ("watchdog", "residual-search") else "displacement"
    untouched, problem = (falling(formulation, globalisation=strategy) for _ in range(2))
    untouched.solve()
    raise_in(problem, signal.SIGUSR1, 2)
    with pytest.raises(Stop):
        problem.solve()
    problem.solve()
    assert largest(problem.fields[0].x.array - untouched.fields[0].x.array) < 1e-8


def test_a_handler_that_raises_nothing_stops_nothing():
    seen = []
    before = signal.signal(signal.SIGUSR2, lambda number, frame: seen.append(number))
    try:
        problem = falling()
        raise_in(problem, signal.SIGUSR2, 2)
        assert problem.solve().iterations > 1
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert seen == [signal.SIGUSR2]


@pytest.mark.mpi
def test_all_ranks_stop_together(handler):
    """A signal on one rank ends the solve on all, at the same iteration."""
    problem = falling()
    raise_in(problem, signal.SIGUSR1, 2 if COMM.rank == 1 else 10**9)
    with pytest.raises(Stop) as caught:
        problem.solve()
    assert caught.value.on_all_ranks
    assert problem.solve().iterations > 1


def test_newton_step_can_be_interrupted(handler):
    problem = falling()
    raise_in(problem, signal.SIGUSR1, 1)
    with pytest.raises(Stop):
        problem.newton_step()
    assert largest(problem.fields[0].x.array) == 0.0
    assert problem.solve().iterations > 1


@pytest.mark.serial
def test_an_error_of_the_user_comes_out_as_it_is():
    """Not as PETSc's, and the problem is alive afterwards."""
    problem = falling(engine=False)
    system, residual, fails = problem.system, type(problem.system).residual, [True]

    def evaluated(b):
        if fails[0]:
            raise ZeroDivisionError("in my function")
        residual(system, b)

    system.residual = evaluated
    with pytest.raises(ZeroDivisionError, match="in my function"):
        problem.solve()
    fails[0] = False
    assert problem.solve().iterations > 1


def test_deferred_signals_come_at_the_end_or_at_a_safe_point(handler):
    passed = []
    with pytest.raises(Stop), deferred():
        signal.raise_signal(signal.SIGUSR1)
        passed.append("after the signal")
        safe_point(COMM)
        passed.append("after the safe point")
    assert passed == ["after the signal"]
    with pytest.raises(Stop), deferred():
        with deferred():
            signal.raise_signal(signal.SIGUSR1)
        passed.append("after the inner one")
    assert passed[1:] == ["after the inner one"]
    with pytest.raises(Stop) as caught, deferred():
        signal.raise_signal(signal.SIGUSR1)
        raise ZeroDivisionError
    assert isinstance(caught.value.__context__, ZeroDivisionError)
    assert signal.getsignal(signal.SIGUSR1) is handler


@pytest.mark.serial
def test_other_threads_get_no_signals():
    found = []
    with deferred():
        pass
    thread = threading.Thread(target=lambda: found.append(falling().solve().iterations))
    thread.start()
    thread.join()
    assert found[0] > 1
