"""What a user adds from outside: each in at most 15 lines, and all of them in one model."""

from __future__ import annotations

import dataclasses
import inspect

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    LOADS,
    MATERIALS,
    MOTIONS,
    SCHEMES,
    History,
    Model,
    point_field,
)
from meshes import Group, Where, box
from solvers import MixedProblem
from tests.bodies import largest, steps
from tests.outside import (  # noqa: F401
    Bed,
    Biot,
    Compliant,
    Kelvin,
    MeanAcceleration,
    Shake,
    registered,
)

COMM = MPI.COMM_WORLD


pytestmark = pytest.mark.usefixtures("registered")


@pytest.mark.parametrize("kind", [MeanAcceleration, Bed, Shake, Biot, Kelvin, Compliant])
def test_fifteen_lines(kind):
    lines = [line for line in inspect.getsource(kind).splitlines() if line.strip()]
    assert len(lines) <= 15


def tagged_bar():
    """A bar whose lower edges carry a tag."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    X = body.gather_points(everywhere=True)
    lower = np.flatnonzero(X[:, 1] == 0.0)
    lower = lower[np.argsort(X[lower, 0])]
    edges = np.sort(np.stack([lower[:-1], lower[1:]], axis=1), axis=1)
    return dataclasses.replace(body, groups={"bottom": Group({1: edges})})


def shaken(formulation, scheme):
    """A bar on a bed, shaken at one end, viscous; its final displacement and velocity."""
    body = tagged_bar()
    end, bottom = Where(extents=(("x", "min"),)), Where(tag="bottom")
    h = fem.Constant(body.mesh, 0.05)
    S_old = point_field(body.mesh, np.eye(2), symmetric=True)
    elastic = MATERIALS["biot"](10.0, 0.3, c=2.0)
    model = Model(
        body,
        formulation,
        lambda S: elastic(S) + 0.2 / h * ufl.inner(S - S_old, S - S_old),
        rho=2.0,
        loads=[LOADS["bed"](3.0, bottom)],
        motions=[MOTIONS["shake"](end, 0.2, 1.0)],
        histories=[History(S_old, Model.stretch)],
    )
    made = SCHEMES[scheme](model.u, h)
    problem = MixedProblem(model.energy(made), model.fields, model.bcs)
    for _ in steps(model, made, problem, 15):
        pass
    return model.u.x.array, made.v.x.array


def test_all_of_them_in_one_model():
    """With the formulation from outside and with the package's; its scheme beside another."""
    u, v = shaken("compliant", "mean-acceleration")
    plain, speed = shaken("displacement", "mean-acceleration")
    assert largest(u) > 0.1
    assert largest(u - plain) < 1e-7
    assert largest(v - speed) < 1e-6
    other, _ = shaken("displacement", "backward-euler")
    assert 1e-3 < largest(u - other) < 0.1
