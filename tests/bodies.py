"""Bodies in any formulation for tests, with all materials and solvers."""

from __future__ import annotations

from functools import cached_property

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from forms import FORMULATIONS, MATERIALS, BackwardEuler, measure, refresh
from solvers import SOLVERS, MixedProblem
from tests.states import random_directions, small_mesh

E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4
INEXACT = [name for name, form in FORMULATIONS.items() if not form.exact]
# The blocks in which a formulation forgets a derivative.
FORGOTTEN = {"lagged-rotation": {("u", "u"), ("Y", "u")}, "gauss-newton": {("u", "u")}}


class Switch:
    """Σₖ χₖ Ψₖ(S) over all materials, of which one χ is 1 and the others are 0."""

    def __init__(self, msh):
        self._chi = {name: fem.Constant(msh, 0.0) for name in MATERIALS}

    def select(self, material):
        for name, chi in self._chi.items():
            chi.value = float(name == material)

    def __call__(self, S):
        return sum(chi * MATERIALS[name](E, NU)(S) for name, chi in self._chi.items())


class Body:
    """A clamped body at rest in some formulation, with all materials and solvers."""

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
    ):
        self.form, self.mesh = FORMULATIONS[formulation], small_mesh(d, simplices=simplices)
        self.psi = Switch(self.mesh) if psi is None else psi
        self.fields = self.form.fields(self.mesh, degree)
        u = self.fields[0]
        self.scheme = BackwardEuler(u, H, (0.0, g, 0.0)[:d])
        energy = self.form.density(*self.fields, self.psi) * measure(u)
        energy += self.scheme.kinetic(RHO) * ufl.dx
        self.energy = fem.form(energy)
        V = u.function_space
        self.clamped = fem.locate_dofs_geometrical(V, lambda X: X[0] < 0.2)
        bc = fem.dirichletbc(np.zeros(d), self.clamped, V)
        self.problems = {
            solver: MixedProblem(
                energy,
                self.fields,
                [bc],
                solver=solver,
                options={"snes_rtol": 1e-13},
            )
            for solver in solvers
        }
        self.at_rest = [f.x.array.copy() for f in self.fields]

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
            self.form.multiplier(*self.fields, self.psi),
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
