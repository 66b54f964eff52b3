"""What a user adds from outside: each in at most 15 lines, and all of them in one model."""

from __future__ import annotations

import dataclasses
import inspect
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    FORMULATIONS,
    LOADS,
    MATERIALS,
    MOTIONS,
    SCHEMES,
    Formulation,
    History,
    Load,
    Material,
    Model,
    Motion,
    Scheme,
    deformation_gradient,
    mixed_fields,
    point_field,
    right_stretch,
)
from forms.constants import as_constant
from meshes import Group, Where, box
from solvers import MixedProblem
from tests.bodies import largest, steps

COMM = MPI.COMM_WORLD


class MeanAcceleration(Scheme):
    """Newmark's method with β = 1/4, γ = 1/2, from a state in equilibrium."""

    def __init__(self, u, h):
        super().__init__(u, h)
        self.a = fem.Function(u.function_space)

    def kinetic(self, rho):
        change = self.u - self.u_old - self.h * self.v - self.h**2 / 4 * self.a
        return 2 * as_constant(rho, self.u.function_space.mesh) / self.h**2 * change**2

    def velocity(self):
        mean = (self.u.x.array - self.u_old.x.array) / self.h.value
        self.a.x.array[:] = 4 * (mean - self.v.x.array) / self.h.value - self.a.x.array
        return 2 * mean - self.v.x.array


@dataclass
class Bed(Load):
    """An elastic bed: k/2 |u|² on facets."""

    k: float
    where: Any = None

    def energy(self, body, u, rho):
        return self.constant(body.mesh, "k") / 2 * ufl.inner(u, u) * body.ds(self.where)


@dataclass(frozen=True)
class Shake(Motion):
    """To and fro along y."""

    amplitude: float
    frequency: float

    def displacement(self, X, t):
        return np.tile([0.0, self.amplitude * np.sin(2 * np.pi * self.frequency * t)], (len(X), 1))


@dataclass(frozen=True)
class Biot(Material):
    """Ψ = μ |S - I|² + λ/2 tr² + c |S - I|⁴."""

    c: float = 0.0

    def strain_energy(self, S, mu, lam):
        strain = S - ufl.Identity(S.ufl_shape[0])
        square = ufl.inner(strain, strain)
        return mu * square + lam / 2 * ufl.tr(strain) ** 2 + self.c * mu * square**2


class Compliant(Formulation):
    """`symmetric` with a small compliance in series, which makes Y's block regular."""

    name = "compliant"

    def fields(self, msh, degree=1):
        return mixed_fields(msh, degree=degree)

    def density(self, u, S, Y, psi):
        constraint = S - right_stretch(deformation_gradient(u))
        return psi(S) - ufl.inner(Y, constraint) - 1e-9 / 2 * ufl.inner(Y, Y)

    def stretch(self, u, S, Y):
        return S

    def stress(self, u, S, Y, psi):
        return FORMULATIONS["symmetric"].stress(u, S, Y, psi)


CLASSES = [MeanAcceleration, Bed, Shake, Biot, Compliant]


@pytest.fixture(autouse=True)
def registered():
    """In the registries, for as long as a test runs."""
    added = [
        (SCHEMES, "mean-acceleration", MeanAcceleration),
        (LOADS, "bed", Bed),
        (MOTIONS, "shake", Shake),
        (MATERIALS, "biot", Biot),
        (FORMULATIONS, "compliant", Compliant()),
    ]
    for registry, name, choice in added:
        registry[name] = choice
    yield
    for registry, name, _ in added:
        del registry[name]


@pytest.mark.parametrize("made", CLASSES)
def test_fifteen_lines(made):
    lines = [line for line in inspect.getsource(made).splitlines() if line.strip()]
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
