"""What a user adds from outside the packages: one of each kind, short."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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


@dataclass(eq=False)
class Bed(Load):
    """An elastic bed: k/2 |u|² on facets."""

    k: float
    where: Any = None

    def __post_init__(self):
        if self.k < 0:
            raise ValueError(f"k is {self.k}; the stiffness of a bed [Pa/m] must not be negative")

    def energy(self, body, u, rho):
        return self.constant(body.mesh, "k") / 2 * ufl.inner(u, u) * body.ds(self.where)


@dataclass(frozen=True)
class Shake(Motion):
    """To and fro along y."""

    amplitude: float
    frequency: float = 1.0

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


@dataclass(frozen=True)
class Kelvin(Material):
    """A dashpot η beside Hooke's spring: Ψ = μ |S - I|² + λ/2 tr² + η/(2h) |S - S_old|²."""

    eta: float

    def strain_energy(self, S, mu, lam):
        strain = S - ufl.Identity(S.ufl_shape[0])
        return mu * ufl.inner(strain, strain) + lam / 2 * ufl.tr(strain) ** 2

    def with_histories(self, msh, degree, h):
        d = msh.geometry.dim
        S_old = point_field(msh, np.eye(d), degree=degree, symmetric=True)

        def psi(S):
            change = ufl.as_matrix([[S[i, j] - S_old[i, j] for j in range(d)] for i in range(d)])
            return self(S) + self.eta / (2 * h) * ufl.inner(change, change)

        return psi, [History(S_old, Model.stretch)]


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


REGISTERED = [
    (SCHEMES, "mean-acceleration", MeanAcceleration),
    (LOADS, "bed", Bed),
    (MOTIONS, "shake", Shake),
    (MATERIALS, "biot", Biot),
    (MATERIALS, "kelvin", Kelvin),
    (FORMULATIONS, "compliant", Compliant()),
]


@pytest.fixture
def registered(monkeypatch):
    """In the registries, for as long as a test runs."""
    for registry, name, choice in REGISTERED:
        monkeypatch.setitem(registry, name, choice)
