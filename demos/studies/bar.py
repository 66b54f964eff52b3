"""The bar of the studies: 4 m × 1 m (× 1 m), under gravity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from forms import FORMULATIONS, MATERIALS, BackwardEuler, Formulation, Material
from meshes import Where, box
from solvers import ConvergenceError, MixedProblem, SolveResult

RHO, GRAVITY, NU = 1000.0, 9.81, 0.45  # [kg/m³], [m/s²], [-]

SUPPORTS = ("clamped", "free", "rotating")
"""Held at x = 0; held nowhere; held nowhere and thrown into a spin of 1 rad/s without gravity."""


@dataclass
class Bar:
    """A bar in one formulation, step by step.

    Attributes:
        form: The formulation.
        psi: The material.
        fields: The unknowns.
        scheme: The time scheme.
        problem: The Newton system.
        kernel: Its compiled kernel, if it has one.
        results: One for each step, the failed one included.
        failure: Why the last step failed, or nothing.
    """

    form: Formulation
    psi: Material
    fields: tuple[fem.Function[Any], ...]
    scheme: BackwardEuler
    problem: MixedProblem
    kernel: Any
    results: list[SolveResult]
    failure: str = ""

    def step(self) -> None:
        """Solve and advance, unless a step has failed. Collective."""
        if self.failure:
            return
        try:
            self.results.append(self.problem.solve())
        except ConvergenceError as error:
            self.results.append(error.result)
            self.failure = error.result.reason
            return
        self.scheme.advance()


def bar(
    comm: MPI.Comm,
    formulation: str,
    *,
    n: int,
    E: float,
    h: float,
    material: str = "stable-neo-hookean",
    dimension: int = 3,
    support: str = "clamped",
    compiled: bool = True,
    projected: bool = False,
    solver: str = "condensed",
    preconditioner: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> Bar:
    """Build a bar at rest, or spinning. Collective.

    Args:
        comm: Communicator.
        formulation: A name in `forms.FORMULATIONS`.
        n: Cells across the bar; 4 n along it.
        E: Young's modulus [Pa].
        h: Time step [s].
        material: A name in `forms.MATERIALS`.
        dimension: 2 or 3.
        support: One of `SUPPORTS`.
        compiled: Whether to use a compiled kernel where there is one.
        projected: See `solvers.MixedProblem`.
        solver: A name in `solvers.SOLVERS`.
        preconditioner: A name in `solvers.PRECONDITIONERS`, with `solver="fieldsplit"`.
        options: PETSc options.
    """
    d = dimension
    body = box(comm, size=(4.0, 1.0, 1.0)[:d], cells=(4 * n, n, n)[:d])
    form = FORMULATIONS[formulation]
    fields = form.fields(body.mesh)
    u = fields[0]
    V = u.function_space
    psi = MATERIALS[material](E, NU)
    gravity = (0.0, 0.0 if support == "rotating" else -GRAVITY, 0.0)[:d]
    scheme = BackwardEuler(u, h, gravity)
    bcs = []
    if support == "clamped":
        dofs = body.dofs(V, Where(extents=(("x", "min"),)))
        bcs.append(fem.dirichletbc(np.zeros(d), dofs, V))
    if support == "rotating":
        X = V.tabulate_dof_coordinates()
        spin = np.zeros((len(X), d))
        spin[:, 0], spin[:, 1] = 0.5 - X[:, 1], X[:, 0] - 2.0
        scheme.v.x.array[:] = spin.ravel()
    kinetic = scheme.kinetic(RHO) * ufl.dx
    kernel = form.kernel(*fields, psi) if compiled and form.kernel is not None else None
    energy = kinetic if kernel is not None else form.density(*fields, psi) * ufl.dx + kinetic
    problem = MixedProblem(
        energy,
        fields,
        bcs,
        solver=solver,
        preconditioner=preconditioner,
        kernel=kernel,
        projected=projected,
        options=options,
    )
    return Bar(form, psi, fields, scheme, problem, kernel, [])
