"""Statics, kinetic energy, and what schemes refuse."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem

from forms import (
    BDF2,
    SCHEMES,
    BackwardEuler,
    Fixed,
    Gravity,
    Model,
    StableNeoHookean,
    Static,
)
from meshes import Where, box
from solvers import MixedProblem
from tests.bodies import largest, steps

COMM = MPI.COMM_WORLD
E, NU, RHO = 2.0, 0.3, 2.0
TIGHT = {"snes_rtol": 1e-13}
CLAMP = Where(extents=(("x", "min"),))


def test_statics():
    """No inertia, whatever the velocity, and no density: the balance of load and stress."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    weight = fem.Constant(body.mesh, (0.0, -0.05))
    model = Model(
        body,
        "symmetric",
        StableNeoHookean(E, NU),
        rho=1.0,
        loads=[Gravity(weight)],
        motions=[Fixed(CLAMP)],
    )
    static = Static(model.u)
    problem = MixedProblem(model.energy(static), model.fields, model.bcs, options=TIGHT)
    assert static.v not in model.energy(static).coefficients()
    (result,) = steps(model, static, problem, 1)
    assert result.iterations > 1
    assert static.t == 1.0
    assert largest(static.v.x.array) == 0.0
    u = model.u.x.array.copy()
    assert largest(u) > 0.1
    # A dynamic step of infinite length ends there, too.
    euler = BackwardEuler(model.u, 1e8)
    problem = MixedProblem(model.energy(euler), model.fields, model.bcs, options=TIGHT)
    model.u.x.array[:] = 0.0
    problem.solve()
    assert largest(model.u.x.array - u) < 1e-10
    assert model.energies(static).now()[0] == 0.0


def test_kinetic_energy():
    """ρ/2 |v|² of a body that moves as one."""
    model = Model(box(COMM, (2.0, 1.0), (4, 2)), "displacement", StableNeoHookean(E, NU), rho=RHO)
    scheme = BDF2(model.u, 0.1)
    scheme.v.x.array[:] = 3.0
    kinetic, elastic, potential = model.energies(scheme).now()
    assert kinetic == pytest.approx(RHO / 2 * (3.0**2 + 3.0**2) * 2.0)
    assert (elastic, potential) == (0.0, 0.0)


@pytest.mark.parametrize("scheme", SCHEMES.values())
def test_what_is_refused(scheme):
    model = Model(box(COMM, (2.0, 1.0), (4, 2)), "displacement", StableNeoHookean(E, NU))
    for h in (0.0, -1.0, np.inf, fem.Constant(model.body.mesh, 0.0)):
        with pytest.raises(ValueError, match=r"the time step .* must be positive and finite"):
            scheme(model.u, h)
    made = scheme(model.u, 1.0)
    if made.inertial:
        with pytest.raises(ValueError, match=f"{scheme.__name__} needs a density; give the model"):
            model.energy(made)
