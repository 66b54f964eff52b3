"""The bar of the studies: 4 m × 1 m (× 1 m), under gravity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh

from demos.scene import SCHEMES
from forms import FORMULATIONS, MATERIALS, BackwardEuler, Formulation, Material, by_tag
from forms.materials import StrainEnergy
from meshes import Body, Where, box
from solvers import ConvergenceError, MixedProblem, SolveResult

Array = npt.NDArray[np.float64]

RHO, GRAVITY, NU = 1000.0, 9.81, 0.45  # [kg/m³], [m/s²], [-]

SUPPORTS = ("clamped", "free", "rotating")
"""Held at x = 0 and let go under gravity; or held nowhere, in weightlessness, and thrown: bent by
an initial velocity of up to 8/3 m/s, or spinning at 1 rad/s."""


@dataclass
class Bar:
    """A bar in one formulation, step by step.

    Attributes:
        form: The formulation.
        psi: The strain energy.
        fields: The unknowns.
        bcs: What holds the bar.
        scheme: The time scheme.
        problem: The Newton system.
        kernel: Its compiled kernel, if it has one.
        results: One for each step, the failed one included.
        failure: Why the last step failed, or nothing.
    """

    form: Formulation
    psi: StrainEnergy
    fields: tuple[fem.Function[Any], ...]
    bcs: list[fem.DirichletBC[Any]]
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
    contrast: float = 1.0,
    scheme: str = "backward-euler",
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
        contrast: How many times stiffer than E the second and the last metre of the bar are.
        scheme: A name in `demos.scene.SCHEMES`.
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
    law = MATERIALS[material](E, NU)
    psi: StrainEnergy = law
    by_cell: Material | tuple[str, Array, Array] = law
    if contrast != 1.0:
        tags = _tagged(body)
        laws = (law, MATERIALS[material](contrast * E, NU))
        psi = by_tag(body.mesh, tags, dict(enumerate(laws)))
        mine = tags.values[: len(body.file_cells)]
        mu, lam = (np.choose(mine, [getattr(m, name) for m in laws]) for name in ("mu", "lam"))
        by_cell = (material, mu, lam)
    gravity = (0.0, -GRAVITY if support == "clamped" else 0.0, 0.0)[:d]
    time = SCHEMES[scheme](u, h, gravity)
    bcs = []
    if support == "clamped":
        dofs = body.dofs(V, Where(extents=(("x", "min"),)))
        bcs.append(fem.dirichletbc(np.zeros(d), dofs, V))
    else:
        X = V.tabulate_dof_coordinates()
        velocity = np.zeros((len(X), d))
        if support == "rotating":
            velocity[:, 0], velocity[:, 1] = 0.5 - X[:, 1], X[:, 0] - 2.0
        else:
            velocity[:, 1] = (X[:, 0] - 2.0) ** 2 - 4.0 / 3.0  # ∫ v = 0
        time.v.x.array[:] = velocity.ravel()
    kinetic = time.kinetic(RHO) * ufl.dx
    kernel = form.kernel(*fields, by_cell) if compiled and form.kernel is not None else None
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
    return Bar(form, psi, fields, bcs, time, problem, kernel, [])


def _tagged(body: Body) -> mesh.MeshTags:
    """0 on the first and third metre of the bar, 1 on the second and fourth. Ghosts included."""
    d = body.mesh.topology.dim
    local = np.arange(len(body.cell_tags.values), dtype=np.int32)
    middle = mesh.compute_midpoints(body.mesh, d, local)[:, 0]
    return mesh.meshtags(body.mesh, d, local, middle.astype(np.int32) % 2)
