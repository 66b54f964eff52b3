"""Reactions, and the balance of energy."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from forms import (
    SCHEMES,
    Account,
    Fixed,
    Gravity,
    HalfSpace,
    Model,
    Pressure,
    Rayleigh,
    StableNeoHookean,
    Static,
    Traction,
    Translate,
)
from meshes import Where, box
from solvers import MixedProblem, march

COMM = MPI.COMM_WORLD
E, NU, RHO = 2.0, 0.3, 2.0
LEFT = Where(extents=(("x", "min"),))
RIGHT = Where(extents=(("x", "max"),))
TOP = Where(extents=(("y", "max"),))


def account_of(model, scheme, **keys):
    problem = MixedProblem(
        model.energy(scheme),
        model.fields,
        model.bcs,
        work=model.virtual_work(scheme),
        options={"snes_rtol": 1e-12},
        **keys,
    )
    return problem, Account(model, scheme, problem.unbalanced_forces)


@pytest.mark.parametrize("formulation", ["symmetric", "displacement", "mean-dilatation"])
@pytest.mark.parametrize("engine", [True, False])
def test_reactions_carry_the_weight(formulation, engine):
    """Whole on one side, and what rollers do not hold is 0 along their free axis."""
    model = Model(
        box(COMM, (2.0, 1.0), (4, 2)),
        formulation,
        StableNeoHookean(E, NU),
        rho=RHO,
        loads=[Gravity((0.02, -0.05))],
        motions=[Fixed(LEFT), Fixed(RIGHT, components="y")],
    )
    scheme = Static(model.u)
    problem, account = account_of(model, scheme, engine=engine)
    list(march(problem, scheme, 1, account))
    weight = 2.0 * RHO * np.array([0.02, -0.05])
    assert account.reactions.sum(axis=0) == pytest.approx(-weight, abs=1e-9)
    assert account.reactions[1, 0] == 0.0
    assert account.reactions[1, 1] > 0.01


def test_where_two_motions_hold_the_last_counts():
    model = Model(
        box(COMM, (2.0, 1.0), (4, 2)),
        "symmetric",
        StableNeoHookean(E, NU),
        motions=[Fixed(LEFT), Translate(LEFT, rate=(0.1, 0.0)), Fixed(RIGHT)],
    )
    scheme = Static(model.u)
    problem, account = account_of(model, scheme)
    list(march(problem, scheme, 1, account))
    assert not account.reactions[0].any()
    assert account.reactions[1] == pytest.approx(-account.reactions[2], abs=1e-9)
    assert account.reactions[1, 0] > 0.05


def left_over(scheme, steps, formulation, keys, damping):
    """What the balance misses after 1 s of a body that is pushed, dragged, damped and in contact.

    Relative to the work of loads and motions without their signs.
    """
    model = Model(
        box(COMM, (2.0, 1.0), (3, 2)),
        formulation,
        StableNeoHookean(E, NU),
        rho=RHO,
        loads=[
            Gravity((0.0, -0.3)),
            Traction(lambda t: (0.1 * np.sin(3 * t), 0.0), TOP),
            Pressure(0.1, RIGHT),
            HalfSpace((0.0, 1.0), stiffness=5.0, offset=0.05),
        ],
        motions=[Translate(LEFT, rate=lambda t: (0.0, 0.2 * np.sin(2 * t) ** 2))],
        damping=damping,
    )
    made = SCHEMES[scheme](model.u, 1.0 / steps, **keys)
    problem, account = account_of(model, made)
    energies = model.energies(made)
    start = energies.now()
    list(march(problem, made, steps, account))
    now, balance = energies.now(), account.balance
    gained = now.kinetic + now.elastic - start.kinetic - start.elastic
    assert damping is None or balance.dissipated > 0.01
    assert min(abs(balance.loads), abs(balance.motions)) > 0.01
    return gained + balance.dissipated - balance.loads - balance.motions


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scheme", "order", "formulation", "keys", "damping"),
    [
        ("backward-euler", 1, "symmetric", {}, Rayleigh(0.3, 0.02)),
        ("implicit-midpoint", 2, "symmetric", {}, None),
        ("implicit-midpoint", 1, "displacement", {}, Rayleigh(0.3, 0.02)),
        ("bdf2", 1, "symmetric", {}, Rayleigh(0.3, 0.0)),
        ("trapezoidal", 1, "symmetric", {}, Rayleigh(0.3, 0.02)),
        ("generalised-alpha", 1, "symmetric", {"rho_inf": 0.5}, None),
    ],
)
def test_balance_of_energy(scheme, order, formulation, keys, damping):
    """Kinetic + elastic + dissipated - work of loads and motions stays, to the order shown."""
    missing = np.abs([left_over(scheme, n, formulation, keys, damping) for n in (20, 40, 80)])
    print(missing, np.log2(missing[:-1] / missing[1:]))
    assert np.log2(missing[1] / missing[2]) > order - 0.2
