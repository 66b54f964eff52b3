"""Bodies in any formulation for tests, with all materials and solvers."""

from __future__ import annotations

from functools import cached_property, partial

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, mesh

import meshes
from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    Fixed,
    Gravity,
    Model,
    lame_parameters,
    refresh,
)
from meshes import Where
from solvers import SOLVERS, MixedProblem, march
from tests.states import random_directions, small_mesh

E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4
# All but the displacement are local to cells.
LOCAL = [name for name in FORMULATIONS if name != "taylor-hood"]
INEXACT = [name for name, form in FORMULATIONS.items() if not form.exact]
# The blocks in which a formulation forgets a derivative.
FORGOTTEN = {"lagged-rotation": {("u", "u"), ("Y", "u")}, "gauss-newton": {("u", "u")}}


# A polynomial of invariants, real powers and logarithms of stretches, and an exponential.
SOME = ("stable-neo-hookean", "ogden", "hencky", "fung")
# Those without a value where det S < 0.
UNDEFINED = ("neo-hookean", "mooney-rivlin", "ogden", "hencky")


class Switch:
    """Σₖ χₖ Ψₖ(S) over materials, of which one χ is 1 and the others are 0.

    A Ψ that is switched off sees no stretch at which it might have no value.
    """

    def __init__(self, msh, materials=tuple(MATERIALS)):
        self.materials = materials
        self._chi = {name: fem.Constant(msh, 0.0) for name in materials}
        self._mu, self._lam = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0)
        self.select()

    def select(self, material=None, E=E, nu=NU):
        self._mu.value, self._lam.value = lame_parameters(E, nu)
        for name, chi in self._chi.items():
            chi.value = float(name == material)

    def __call__(self, S):
        I = ufl.Identity(S.ufl_shape[0])  # noqa: E741
        return sum(
            chi
            * MATERIALS[name](E, NU).strain_energy(
                I + chi * (S - I) if name in UNDEFINED else S, self._mu, self._lam
            )
            for name, chi in self._chi.items()
        )


def body_on(msh):
    """A body of any mesh."""
    cells = msh.topology.index_map(msh.topology.dim)
    every = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    return meshes.Body(msh, mesh.meshtags(msh, msh.topology.dim, every, np.zeros_like(every)))


LEFT = Where(extents=(("x", (-1.0, 0.2)),))
"""The clamped end of the small meshes."""


class Body:
    """A clamped body at rest in some formulation, with several materials and all solvers."""

    def __init__(
        self,
        formulation,
        d=2,
        psi=None,
        solvers=tuple(SOLVERS),
        g=-2.0,
        *,
        degree=1,
        simplices=True,
        materials=tuple(MATERIALS),
    ):
        self.form, self.mesh = FORMULATIONS[formulation], small_mesh(d, simplices=simplices)
        self.psi = Switch(self.mesh, materials) if psi is None else psi
        body = body_on(self.mesh)
        model = Model(
            body,
            formulation,
            self.psi,
            rho=RHO,
            loads=[Gravity((0.0, g, 0.0)[:d])],
            motions=[Fixed(LEFT)],
            degree=degree,
        )
        self.fields = model.fields
        self.scheme = BackwardEuler(model.u, H)
        self._energy = energy = model.energy(self.scheme)
        self.clamped = body.dofs(model.u.function_space, LEFT)
        self._make = partial(
            MixedProblem, energy, self.fields, model.bcs, options={"snes_rtol": 1e-13}
        )
        self.problems = {solver: self._make(solver=solver) for solver in solvers}
        self.at_rest = [f.x.array.copy() for f in self.fields]

    @cached_property
    def energy(self):
        return fem.form(self._energy)

    @cached_property
    def assembled(self):
        """A problem with UFL's residual and Jacobian, for a look at these."""
        return self.problems.get("direct") or self._make(solver="direct")

    def start(self):
        """Put the rest state into the fields."""
        for f, values in zip(self.fields, self.at_rest, strict=True):
            f.x.array[:] = values

    def move(self):
        """Move every field far from where it is."""
        for f, change in zip(self.fields, random_directions(self.fields, stress=E), strict=True):
            f.x.array[:] += 0.5 * change

    def solve(self, solver="condensed"):
        """Solve a step from rest."""
        self.start()
        return self.problems[solver].solve()

    @cached_property
    def _state(self):
        expressions = (
            self.form.stretch(*self.fields),
            self.form.stress(*self.fields, self.psi),
        )
        points = np.full((1, 2), 1 / 3)
        return [(e, fem.Expression(e, points)) for e in expressions]

    def cellwise(self):
        """S and Λ on the owned cells, in 2D."""
        cells = np.arange(self.mesh.topology.index_map(2).size_local, dtype=np.int32)
        refresh(expression for expression, _ in self._state)
        return [compiled.eval(self.mesh, cells) for _, compiled in self._state]


def largest(values):
    return MPI.COMM_WORLD.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


def steps(model, scheme, problem, count):
    """Take steps of a model, yielding the result of each."""
    return march(problem, scheme, count, model)
