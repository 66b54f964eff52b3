"""The bar of the studies: 4 m × 1 m (× 1 m), under gravity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import mesh

from forms import MATERIALS, SCHEMES, Fixed, Gravity, Model, Scheme, by_tag
from forms.materials import StrainEnergy
from meshes import Body, Where, box
from solvers import ConvergenceError, MixedProblem, SolveResult, Strategy

Array = npt.NDArray[np.float64]

RHO, GRAVITY, NU = 1000.0, 9.81, 0.45  # [kg/m³], [m/s²], [-]

SUPPORTS = ("clamped", "free", "rotating")
"""Held at x = 0 and let go under gravity; or held nowhere, in weightlessness, and thrown: bent by
an initial velocity of up to 8/3 m/s, or spinning at 1 rad/s."""


BASELINES: dict[str, str | None] = {"displacement": None, "on demand": "project-on-demand"}
"""The displacement's Newton as it gets through most of `study duel`, by globalisation: full steps
with a search and a way down behind them, and the tangent that is projected where it must be."""


@dataclass
class Bar:
    """A bar in one formulation, step by step.

    Attributes:
        model: What the bar is.
        scheme: The time scheme.
        problem: The Newton system.
        results: One for each step, the failed one included.
        failure: Why the last step failed, or nothing.
    """

    model: Model
    scheme: Scheme
    problem: MixedProblem
    results: list[SolveResult]
    failure: str = ""

    def step(self) -> None:
        """Solve and advance, unless a step has failed. Collective."""
        if self.failure:
            return
        self.model.update(self.scheme)
        try:
            self.results.append(self.problem.solve())
        except ConvergenceError as error:
            self.results.append(error.result)
            self.failure = error.result.reason
            return
        self.model.accept(self.scheme)


def bar(
    comm: MPI.Comm,
    formulation: str,
    *,
    n: int,
    E: float,
    h: float,
    contrast: float = 1.0,
    scheme: str = "backward-euler",
    material: str = "stable-neo-hookean",
    psi: StrainEnergy | None = None,
    dimension: int = 3,
    support: str = "clamped",
    globalisation: str | Strategy | None = None,
    solver: str = "condensed",
    preconditioner: str | None = None,
    options: Mapping[str, Any] | None = None,
    body: Body | None = None,
) -> Bar:
    """Build a bar at rest, or spinning. Collective.

    Args:
        comm: Communicator.
        formulation: A name in `forms.FORMULATIONS`.
        n: Cells across the bar; 4 n along it.
        E: Young's modulus [Pa].
        h: Time step [s].
        contrast: How many times stiffer than E the second and the last metre of the bar are.
        scheme: A name in `forms.SCHEMES`.
        material: A name in `forms.MATERIALS`.
        psi: A strain energy density in the place of that material.
        dimension: 2 or 3.
        support: One of `SUPPORTS`.
        globalisation: See `solvers.MixedProblem`.
        solver: A name in `solvers.SOLVERS`.
        preconditioner: A name in `solvers.PRECONDITIONERS`, with `solver="fieldsplit"`.
        options: PETSc options.
        body: Its mesh, if there is one already.
    """
    d = dimension
    body = body or mesh_of_bar(comm, n, d)
    law = MATERIALS[material](E, NU)
    psi = psi or law
    if contrast != 1.0:
        tags = _tagged(body)
        laws = (law, MATERIALS[material](contrast * E, NU))
        psi = by_tag(body.mesh, tags, dict(enumerate(laws)))
    clamped = support == "clamped"
    model = Model(
        body,
        formulation,
        psi,
        rho=RHO,
        loads=[Gravity((0.0, -GRAVITY, 0.0)[:d])] if clamped else [],
        motions=[Fixed(Where(extents=(("x", "min"),)))] if clamped else [],
    )
    time = SCHEMES[scheme](model.u, h)
    if not clamped:
        V = model.u.function_space
        X = V.tabulate_dof_coordinates()
        velocity = np.zeros((len(X), d))
        if support == "rotating":
            velocity[:, 0], velocity[:, 1] = 0.5 - X[:, 1], X[:, 0] - 2.0
        else:
            velocity[:, 1] = (X[:, 0] - 2.0) ** 2 - 4.0 / 3.0  # ∫ v = 0
        time.v.x.array[:] = velocity.ravel()
    problem = MixedProblem(
        model.energy(time),
        model.fields,
        model.bcs,
        solver=solver,
        preconditioner=preconditioner,
        globalisation=globalisation,
        options=options,
    )
    return Bar(model, time, problem, [])


def mesh_of_bar(comm: MPI.Comm, n: int, dimension: int = 3) -> Body:
    """The mesh of a bar with n cells across and 4 n along it. Collective."""
    d = dimension
    return box(comm, size=(4.0, 1.0, 1.0)[:d], cells=(4 * n, n, n)[:d])


def _tagged(body: Body) -> mesh.MeshTags:
    """0 on the first and third metre of the bar, 1 on the second and fourth. Ghosts included."""
    d = body.mesh.topology.dim
    local = np.arange(len(body.cell_tags.values), dtype=np.int32)
    middle = mesh.compute_midpoints(body.mesh, d, local)[:, 0]
    return mesh.meshtags(body.mesh, d, local, middle.astype(np.int32) % 2)
