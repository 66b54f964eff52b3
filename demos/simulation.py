"""From a scene to a sequence of converged states."""

from __future__ import annotations

import logging
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
from forms import FORMULATIONS, MATERIALS, Formulation
from meshes import Body, MeshError, box, read
from solvers import CellKernel, MixedProblem, SolveResult, march

logger = logging.getLogger("mixed_fem")


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
        kernels: What evaluates the Newton system, "compiled" or "ufl".
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
        energy = self.scheme.kinetic(rho) * ufl.dx
        kernel = None
        if scene.kernels == "compiled" and scene.solver == "condensed":
            kernel = _kernel(form, self.fields, scene, body)
        if kernel is None:
            energy = form.density(*self.fields, psi) * ufl.dx + energy
        self.kernels = "ufl" if kernel is None else "compiled"
        self.problem = MixedProblem(
            energy, self.fields, _bcs(scene, body, u), solver=scene.solver, kernel=kernel
        )
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


def _parameters(scene: Scene, body: Body) -> npt.NDArray[np.float64]:
    """μ, λ [Pa] and ρ [kg/m³] of each local cell, ghosts included, shape (3, cells)."""
    kind = MATERIALS[scene.psi]
    values = np.empty((3, len(body.cell_tags.values)))
    for given in scene.materials:
        material = kind(given.E, given.nu)
        cells = slice(None) if given.tag is None else body.cell_tags.find(given.tag)
        values[:, cells] = [[material.mu], [material.lam], [given.rho]]
    return values


def _material(scene: Scene, body: Body) -> tuple[Callable[[Expr], Expr], float | Expr]:
    """Strain energy and density; several materials become piecewise constant parameters."""
    first = scene.materials[0]
    material = MATERIALS[scene.psi](first.E, first.nu)
    if len(scene.materials) == 1:
        return material, first.rho
    space = fem.functionspace(body.mesh, ("DG", 0))
    mu, lam, rho = (fem.Function(space) for _ in range(3))
    for f, values in zip((mu, lam, rho), _parameters(scene, body), strict=True):
        f.x.array[space.dofmap.list.ravel()] = values
    return (lambda S: material.strain_energy(S, mu, lam)), rho


def _kernel(
    form: Formulation, fields: tuple[fem.Function[Any], ...], scene: Scene, body: Body
) -> CellKernel | None:
    """The compiled kernel of a formulation; None, and a warning, where there is none."""
    if form.kernel is None:
        return None
    owned = body.mesh.topology.index_map(body.mesh.topology.dim).size_local
    mu, lam, _ = _parameters(scene, body)[:, :owned]
    try:
        return form.kernel(*fields, (scene.psi, mu, lam))
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        logger.warning("numba is not installed: the Newton system by UFL alone, the slow way")
        return None


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
