"""From a scene to a sequence of converged states."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from demos.app.scene import Scene
from demos.app.tables import SceneError
from forms import (
    FORMULATIONS,
    SCHEMES,
    Account,
    Energies,
    History,
    Model,
    by_tag,
    cell_values,
    deformation_gradient,
    displacement_field,
    von_mises_stress,
)
from forms.expressions import PointValues
from forms.materials import StrainEnergy
from forms.points import is_simplicial
from meshes import (
    VTK_ORDER,
    Body,
    MeshError,
    box,
    connected_parts,
    geometry,
    read,
    refine,
    told_parts,
)
from solvers import MixedProblem, Pace, SolveResult, march

logger = logging.getLogger("mixed_fem")


def build_body(scene: Scene, comm: MPI.Comm) -> Body:
    """The body of a scene, checked against the rest of it.

    Raises:
        SceneError: The mesh cannot be used, or the scene asks for what it does not have.
    """
    try:
        source = scene.mesh
        if source.file is not None:
            body = read(comm, source.file, scale=source.scale)
        elif source.geometry is not None:
            body = geometry(comm, source.geometry, source.h, scale=source.scale)
        else:
            body = box(comm, [x * source.scale for x in source.size], source.cells, source.cell)
        body = refine(body, source.refine)
    except MeshError as e:
        raise SceneError(f"{scene.source}: [mesh]: {e}") from e
    wanted = [m.tag for m in scene.regions if m.tag is not None]
    if wanted:
        tagged = body.tagged_cells()
        try:
            body.regions(wanted)
        except MeshError as e:
            raise SceneError(
                f"{scene.source}: [[material]] tag: the cells of the mesh are tagged {tagged}, the "
                f"materials {wanted}; each cell needs one material, and {e}"
            ) from e
    _check_parts(scene, body)
    parts = connected_parts(body, [given.motion.where for given in scene.boundaries])
    if comm.rank == 0 and len(parts) > 1:
        logger.warning("%s: %s", scene.source, told_parts(parts))
    return body


def _check_parts(scene: Scene, body: Body) -> None:
    """Insist that each motion and load goes with the body, so that messages name its place."""
    u = displacement_field(body.mesh)
    v = ufl.TestFunction(u.function_space)
    rho = fem.Constant(body.mesh, 1.0)
    for boundary in scene.boundaries:
        with _told_at(scene, boundary.place):
            boundary.motion.hold(body, u.function_space)
    for given in scene.loads:
        with _told_at(scene, given.place):
            given.load.energy(body, u, rho)
            given.load.work(body, u, v)


@contextmanager
def _told_at(scene: Scene, place: str) -> Iterator[None]:
    """Say of what is refused where in the scene it is asked for.

    Raises:
        SceneError: In the place of a ValueError.
    """
    try:
        yield
    except ValueError as e:
        raise SceneError(f"{scene.source}: {place}: {e}") from e


class Simulation:
    """A scene, ready to march.

    Attributes:
        body: The mesh.
        model: What the body is.
        fields: The unknowns, the displacement [m] first.
        problem: The Newton system.
        scheme: The time scheme; knows time and velocity.
        account: Works of loads and motions, and reactions of the latter in the scene's order.
        pace: Where `march` stands.
    """

    def __init__(self, scene: Scene, body: Body) -> None:
        """Build the forms and compile them.

        Args:
            scene: What to run.
            body: Its body, from `build_body`.

        Raises:
            SceneError: The formulation does not go with the cells, the degree, the material, the
                scheme or the solver.
        """
        self.body = body
        h = fem.Constant(body.mesh, scene.h)
        degree = FORMULATIONS[scene.formulation].degree_of_u(scene.degree)
        psi, rho, histories, moduli = _material(scene, body, degree, h)
        damping = replace(scene.damping, moduli=moduli)
        place = f'[solve] formulation = "{scene.formulation}"'
        with _told_at(scene, place):
            self.model = Model(
                body,
                scene.formulation,
                psi,
                rho=rho,
                loads=[given.load for given in scene.loads],
                motions=[given.motion for given in scene.boundaries],
                histories=histories,
                damping=damping,
                degree=scene.degree,
            )
        with _told_at(scene, "[time]"):
            self.scheme = SCHEMES[scene.scheme](self.model.u, h, **scene.scheme_keys)
        with _told_at(scene, "[start]"):
            scene.start(self.model, self.scheme, body, scene.folder)
        with _told_at(scene, place):
            energy = self.model.energy(self.scheme)
        self.fields = self.model.fields
        with _told_at(scene, f'[solve] solver = "{scene.solver}"'):
            self.problem = MixedProblem(
                energy,
                self.fields,
                self.model.bcs,
                work=self.model.virtual_work(self.scheme),
                solver=scene.solver,
                globalisation=scene.globalisation,
            )
        self._control = scene.control
        self.pace = Pace()
        self._energies = self.model.energies(self.scheme)
        self.account = Account(self.model, self.scheme, self.problem.unbalanced_forces)
        stretch = self.model.stretch(self.scheme)
        self._means = _Means(
            CellMeans(
                gradient=deformation_gradient(self.model.u),
                stretch=stretch,
                stress=self.model.stress(self.scheme),
                von_mises=von_mises_stress(stretch, psi),
                energy_density=psi(stretch),
            ),
            self.model.u,
        )

    def march(self, steps: int) -> Iterator[SolveResult]:
        """Yield the result of each step; go on from where `pace` stands.

        Args:
            steps: Of the length of the scene, from the very beginning.

        Raises:
            ConvergenceError: A step failed; the state is that after the step before.
        """
        return march(self.problem, self.scheme, steps, self.account, self._control, self.pace)

    def energies(self) -> Energies:
        """Energies [J] of the whole body after the last step. Collective."""
        return self._energies.now()

    def cell_means(self) -> CellMeans[npt.NDArray[np.float64]]:
        """Means over each owned cell after the last step. Collective."""
        return self._means.now()

    @cached_property
    def at_rest(self) -> tuple[npt.NDArray[Any] | None, ...]:
        """Positions at rest [m], tags and vertices of cells, on rank 0 in file order. Collective.

        Gathered once, as no step changes them.
        """
        body = self.body
        tags = body.cell_tags.values[: len(body.file_cells)]
        return body.gather_points(), body.gather(tags), body.gather(_vtk_cells(body))


class CellMeans[T](NamedTuple):
    """What is told of cells: means over the points at which cell-local fields live.

    Attributes:
        gradient: Deformation gradient F, shape (owned cells, d, d).
        stretch: Right stretch S, likewise.
        stress: First Piola-Kirchhoff stress Λ [Pa], likewise.
        von_mises: Von Mises stress [Pa], shape (owned cells,).
        energy_density: Strain energy density Ψ [J/m³], likewise.
    """

    gradient: T
    stretch: T
    stress: T
    von_mises: T
    energy_density: T


class _Means:
    """Cell means, compiled together, as each compilation takes its time."""

    def __init__(self, expressions: CellMeans[Expr], u: fem.Function[Any]) -> None:
        self._shapes = [e.ufl_shape for e in expressions]
        entries = [e[i] if i else e for e in expressions for i in np.ndindex(e.ufl_shape)]
        self._points = PointValues(ufl.as_vector(entries), u)

    def now(self) -> CellMeans[npt.NDArray[np.float64]]:
        weights = self._points.weights / self._points.weights.sum()
        means = np.einsum("q,kqi->ki", weights, self._points.now())
        sizes = [math.prod(shape) for shape in self._shapes]
        parts = np.split(means, np.cumsum(sizes)[:-1], axis=1)
        return CellMeans(
            *(a.reshape(-1, *shape) for a, shape in zip(parts, self._shapes, strict=True))
        )


def _vtk_cells(body: Body) -> npt.NDArray[Any]:
    """Vertices of the owned cells in the order of VTK, or sorted where any order will do."""
    cells = body.file_connectivity()
    if is_simplicial(body.mesh):
        return np.sort(cells)
    return cells[:, VTK_ORDER[body.mesh.topology.cell_type]]


def _material(
    scene: Scene, body: Body, degree: int, h: fem.Constant
) -> tuple[StrainEnergy, float | Expr, list[History], tuple[float | Expr, float | Expr]]:
    """Strain energy, density, history variables and rest moduli (μ, λ), by cell tag if needed.

    Args:
        scene: The scene.
        body: Its body.
        degree: Of the displacement.
        h: Time step.
    """
    laws: list[StrainEnergy] = []
    histories: list[History] = []
    for region in scene.regions:
        psi, remembered = region.material.with_histories(body.mesh, degree, h)
        laws.append(psi)
        histories += remembered
    if len(laws) == 1:
        return laws[0], scene.regions[0].rho, histories, scene.regions[0].material.rest
    tags = body.regions([region.tag for region in scene.regions if region.tag is not None])
    densities = {k: region.rho for k, region in enumerate(scene.regions)}
    psi = by_tag(body.mesh, tags, dict(enumerate(laws)))
    mu, lam = (
        cell_values(body.mesh, tags, {k: r.material.rest[i] for k, r in enumerate(scene.regions)})
        for i in (0, 1)
    )
    return psi, cell_values(body.mesh, tags, densities), histories, (mu, lam)
