"""From a scene to a sequence of converged states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from demos.scene import SCHEMES, Scene
from demos.tables import SceneError
from forms import FORMULATIONS, MATERIALS
from meshes import Body, MeshError, box, read
from solvers import MixedProblem, SolveResult, march


@dataclass(frozen=True)
class Energies:
    """Energies [J] of the whole body at the end of a step."""

    kinetic: float
    elastic: float
    potential: float


def build_body(scene: Scene, comm: MPI.Comm) -> Body:
    """The body of a scene, checked against the rest of it.

    Raises:
        SceneError: The mesh cannot be used, or the scene asks for what it does not have.
    """
    try:
        if scene.mesh.file is not None:
            body = read(comm, scene.mesh.file)
        else:
            body = box(comm, scene.mesh.size, scene.mesh.cells)
    except MeshError as e:
        raise SceneError(f"{scene.source}: [mesh]: {e}") from e
    d = body.mesh.geometry.dim
    if scene.gravity and len(scene.gravity) != d:
        raise SceneError(
            f"{scene.source}: [load] gravity = {list(scene.gravity)}: must have {d} entries, as "
            "the mesh has dimensions"
        )
    wanted = {m.tag for m in scene.materials if m.tag is not None}
    if wanted:
        found = set(np.concatenate(comm.allgather(np.unique(body.cell_tags.values))).tolist())
        if wanted != found:
            raise SceneError(
                f"{scene.source}: [[material]] tag: the cells of the mesh are tagged "
                f"{sorted(found)}, the materials {sorted(wanted)}; each tag needs one material"
            )
    return body


class Simulation:
    """A scene in one formulation, ready to march.

    Attributes:
        body: The mesh.
        fields: The unknowns, the displacement [m] first.
        problem: The Newton system.
        scheme: The time scheme; knows time and velocity.
    """

    def __init__(self, scene: Scene, body: Body, formulation: str) -> None:
        """Build the forms and compile them.

        Args:
            scene: What to run.
            body: Its body, from `build_body`.
            formulation: Name of the formulation; the one of the scene is not looked at.

        Raises:
            SceneError: A boundary holds no vertex of the body.
        """
        form = FORMULATIONS[formulation]
        self.body = body
        self.fields = form.fields(body.mesh)
        u = self.fields[0]
        self.scheme = SCHEMES[scene.scheme](u, scene.h, scene.gravity)
        psi, rho = _material(scene, body)
        energy = (self.scheme.kinetic(rho) + form.density(*self.fields, psi)) * ufl.dx
        self.problem = MixedProblem(energy, self.fields, _bcs(scene, body, u), solver=scene.solver)
        self._energies = [
            fem.form(density * ufl.dx)
            for density in (
                self.scheme.kinetic_energy(rho),
                psi(form.stretch(*self.fields)),
                self.scheme.potential_energy(rho),
            )
        ]
        points = np.full((1, body.mesh.geometry.dim), 1 / (body.mesh.geometry.dim + 1))
        self._stretch = fem.Expression(form.stretch(*self.fields), points)
        self._stress = fem.Expression(form.multiplier(*self.fields, psi), points)

    def march(self, steps: int) -> Iterator[SolveResult]:
        """Yield the result of each step.

        Raises:
            ConvergenceError: A step failed; the state is that after the step before.
        """
        return march(self.problem, self.scheme, steps)

    def energies(self) -> Energies:
        """Energies after the last step. Collective."""
        self.problem.refresh()
        comm = self.body.mesh.comm
        local = [fem.assemble_scalar(form) for form in self._energies]
        return Energies(*(float(comm.allreduce(value)) for value in local))

    def stretch(self) -> npt.NDArray[np.float64]:
        """Right stretch S on the owned cells, shape (owned cells, d, d)."""
        return self._on_cells(self._stretch)

    def stress(self) -> npt.NDArray[np.float64]:
        """First Piola-Kirchhoff stress Λ [Pa] on the owned cells, shape (owned cells, d, d)."""
        return self._on_cells(self._stress)

    def _on_cells(self, expression: fem.Expression[Any]) -> npt.NDArray[np.float64]:
        self.problem.refresh()
        d = self.body.mesh.geometry.dim
        cells = np.arange(len(self.body.file_cells), dtype=np.int32)
        return np.asarray(expression.eval(self.body.mesh, cells)).reshape(-1, d, d)


def _material(scene: Scene, body: Body) -> tuple[Callable[[Expr], Expr], float | Expr]:
    """Strain energy and density; several materials become piecewise constant parameters."""
    kind = MATERIALS[scene.psi]
    materials = [kind(m.E, m.nu) for m in scene.materials]
    if len(materials) == 1:
        return materials[0], scene.materials[0].rho
    space = fem.functionspace(body.mesh, ("DG", 0))
    mu, lam, rho = fem.Function(space), fem.Function(space), fem.Function(space)
    for given, material in zip(scene.materials, materials, strict=True):
        dofs = space.dofmap.list[body.cell_tags.find(given.tag)].ravel()
        mu.x.array[dofs] = material.mu
        lam.x.array[dofs] = material.lam
        rho.x.array[dofs] = given.rho
    return (lambda S: materials[0].strain_energy(S, mu, lam)), rho


def _bcs(scene: Scene, body: Body, u: fem.Function[Any]) -> list[fem.DirichletBC[Any]]:
    V = u.function_space
    bcs = []
    for boundary in scene.boundaries:
        try:
            dofs = body.dofs(V, boundary.where)
        except MeshError as e:
            raise SceneError(f"{scene.source}: [[boundary]] where = {e}") from e
        bcs.append(fem.dirichletbc(np.zeros(body.mesh.geometry.dim), dofs, V))
    return bcs
