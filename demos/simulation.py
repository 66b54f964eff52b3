"""From a scene to a sequence of converged states."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from demos.scene import SCHEMES, Scene
from demos.tables import SceneError
from forms import (
    FORMULATIONS,
    MATERIALS,
    Formulation,
    by_tag,
    cell_values,
    lame_parameters,
    measure,
    quadrature_degree,
    refresh,
    von_mises_stress,
)
from forms.kernels import MATERIALS as KERNEL_MATERIALS
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
            body = box(comm, scene.mesh.size, scene.mesh.cells, scene.mesh.cell)
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
            SceneError: A boundary holds no vertex of the body, or the scene insists on kernels that
                there are not.
        """
        form = FORMULATIONS[formulation]
        self.body = body
        self.fields = form.fields(body.mesh, scene.degree)
        u = self.fields[0]
        dx = measure(u)
        self.scheme = SCHEMES[scene.scheme](u, scene.h, scene.gravity)
        psi, rho = _material(scene, body)
        energy = self.scheme.kinetic(rho) * ufl.dx
        kernel = None if scene.kernels == "ufl" else _kernel(form, self.fields, scene, body)
        if kernel is None:
            energy = form.density(*self.fields, psi) * dx + energy
        self.kernels = "ufl" if kernel is None else "compiled"
        self.problem = MixedProblem(
            energy, self.fields, _bcs(scene, body, u), solver=scene.solver, kernel=kernel
        )
        stretch = form.stretch(*self.fields)
        self._energies = [
            self.scheme.kinetic_energy(rho) * ufl.dx,
            psi(stretch) * dx,
            self.scheme.potential_energy(rho) * ufl.dx,
        ]
        self._compiled_energies = [fem.form(energy) for energy in self._energies]
        self._stretch = CellMeans(stretch, u)
        self._stress = CellMeans(form.multiplier(*self.fields, psi), u)
        self._von_mises = CellMeans(von_mises_stress(stretch, psi), u)

    def march(self, steps: int) -> Iterator[SolveResult]:
        """Yield the result of each step.

        Raises:
            ConvergenceError: A step failed; the state is that after the step before.
        """
        return march(self.problem, self.scheme, steps)

    def energies(self) -> Energies:
        """Energies after the last step. Collective."""
        refresh(self._energies)
        comm = self.body.mesh.comm
        local = [fem.assemble_scalar(form) for form in self._compiled_energies]
        return Energies(*(float(comm.allreduce(value)) for value in local))

    def stretch(self) -> npt.NDArray[np.float64]:
        """Right stretch S on the owned cells, shape (owned cells, d, d)."""
        return self._stretch.values()

    def stress(self) -> npt.NDArray[np.float64]:
        """First Piola-Kirchhoff stress Λ [Pa] on the owned cells, shape (owned cells, d, d)."""
        return self._stress.values()

    def von_mises(self) -> npt.NDArray[np.float64]:
        """Von Mises stress [Pa] on the owned cells, shape (owned cells,)."""
        return self._von_mises.values()


class CellMeans:
    """Means of an expression over the points of each owned cell at which cell-local fields live."""

    def __init__(self, expression: Expr, u: fem.Function[Any]) -> None:
        """Compile the expression.

        Args:
            expression: Of the fields of a formulation.
            u: The displacement among them.
        """
        self._mesh, self._expression = u.function_space.mesh, expression
        points, weights = (
            np.array(a, dtype=np.float64)
            for a in basix.make_quadrature(
                self._mesh.basix_cell(), quadrature_degree(u.function_space)
            )
        )
        self._weights = weights / weights.sum()
        self._compiled = fem.Expression(expression, points)
        cells = self._mesh.topology.index_map(self._mesh.topology.dim).size_local
        self._cells = np.arange(cells, dtype=np.int32)

    def values(self) -> npt.NDArray[np.float64]:
        """Present means, shape (owned cells, *shape of the expression)."""
        refresh([self._expression])
        values = self._compiled.eval(self._mesh, self._cells)
        return np.asarray(np.einsum("q,kq...->k...", self._weights, values), dtype=np.float64)


def _material(scene: Scene, body: Body) -> tuple[Callable[[Expr], Expr], float | Expr]:
    """Strain energy and density, by cell tag if there are several materials."""
    first = scene.materials[0]
    if len(scene.materials) == 1:
        return MATERIALS[first.name](first.E, first.nu), first.rho
    laws = {m.tag: MATERIALS[m.name](m.E, m.nu) for m in scene.materials if m.tag is not None}
    densities = {m.tag: m.rho for m in scene.materials if m.tag is not None}
    return (
        by_tag(body.mesh, body.cell_tags, laws),
        cell_values(body.mesh, body.cell_tags, densities),
    )


def _kernel(
    form: Formulation, fields: tuple[fem.Function[Any], ...], scene: Scene, body: Body
) -> CellKernel | None:
    """The compiled kernel of a formulation, or None where there is none.

    Raises:
        SceneError: There is none, and the scene insists on one.
    """
    names = {m.name for m in scene.materials}
    if scene.solver != "condensed":
        reason = f'none go with the solver "{scene.solver}"; take "condensed"'
    elif quadrature_degree(fields[0].function_space) > 0:
        reason = "there are none but for displacements of degree 1 on triangles or tetrahedra"
    elif form.kernel is None:
        known = ", ".join(name for name, f in FORMULATIONS.items() if f.kernel is not None)
        reason = f'there are none for the formulation "{form.name}"; there are for {known}'
    elif len(names) > 1 or not names <= set(KERNEL_MATERIALS):
        spelled = ", ".join(sorted(names))
        known = ", ".join(KERNEL_MATERIALS)
        reason = f"there are none for {spelled}; there are for one strain energy out of {known}"
    else:
        mu, lam = _lame_parameters(scene, body)
        try:
            return form.kernel(*fields, (names.pop(), mu, lam))
        except ModuleNotFoundError as error:
            if error.name != "numba":
                raise
            reason = "numba is not installed"
            logger.warning("%s: the Newton system by UFL alone, the slow way", reason)
    if scene.kernels == "compiled":
        raise SceneError(f'{scene.source}: [solve] kernels = "compiled": {reason}')
    return None


def _lame_parameters(scene: Scene, body: Body) -> npt.NDArray[np.float64]:
    """μ and λ [Pa] of each owned cell, shape (2, owned cells)."""
    values = np.empty((2, len(body.cell_tags.values)))
    for given in scene.materials:
        cells = slice(None) if given.tag is None else body.cell_tags.find(given.tag)
        values[:, cells] = np.array([lame_parameters(given.E, given.nu)]).T
    return values[:, : len(body.file_cells)]


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
