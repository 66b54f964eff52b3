"""What can be measured of a run, by names such as `tip.y` or `energy.elastic`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import scipy
from dolfinx import geometry

from demos.app.simulation import Simulation
from forms import Energies
from solvers import SolveResult

Array = npt.NDArray[np.float64]

AXES = "xyz"
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
PLACE = rf"\(({NUMBER}(?:,{NUMBER}){{1,2}})\)"

KINDS = {
    "tip.y": "coordinate [m] of the vertex that is farthest from the first held part",
    "at(X,Y,Z).x": "coordinate [m] of the point that was at X, Y, Z; in 2D at(X,Y)",
    "von_mises(X,Y,Z)": "von Mises stress [Pa] of the cell in which that point lies",
    "strain(X,Y,Z)": "|S - I| of that cell",
    "reaction.1.x": "force [N] that the first [[boundary]] exerts on the body",
    "energy.elastic": "energy [J]: kinetic, elastic, potential, dissipated or missing",
    "work.loads": "work [J]: loads or motions",
    "iterations": "Newton iterations of all steps; iterations.most of one step",
    "krylov": "linear iterations of all steps",
    "seconds": "wall time [s] of all steps, without preparation",
}
"""By example."""


class MeasureError(ValueError):
    """There is no such measure; the message is one line."""


@dataclass(frozen=True)
class Finished:
    """A run that has come to its end.

    Attributes:
        simulation: Its last state.
        results: Of each step.
        start: Energies at the beginning.
    """

    simulation: Simulation
    results: Sequence[SolveResult]
    start: Energies


Measure = Callable[[Finished], float]


def measure(name: str) -> Measure:
    """The function that measures what a name says. It is collective.

    Raises:
        MeasureError: There is none. Whether the body has the point or the axis shows later.
    """
    for pattern, make in _MEASURES:
        if found := re.fullmatch(pattern, name.replace(" ", "")):
            return make(*found.groups())
    known = ", ".join(KINDS)
    raise MeasureError(f"--measure {name}: unknown; there are, by example, {known}")


def tip(simulation: Simulation) -> Array:
    """Rest position [m] of the vertex farthest from what the first motion holds. Collective.

    Without motions from the middle of the body; of several the last by x, then y, then z.
    """
    X = simulation.body.gather_points(everywhere=True)
    assert X is not None  # on all ranks
    origin = X.mean(axis=0, keepdims=True)
    if simulation.model.held:
        V = simulation.model.u.function_space
        here = V.tabulate_dof_coordinates()[simulation.model.held[0].blocks, : X.shape[1]]
        origin = np.concatenate(V.mesh.comm.allgather(here))
    distance = scipy.spatial.cKDTree(origin).query(X)[0]
    farthest = X[distance > distance.max() * (1 - 1e-9)]
    found: Array = farthest[np.lexsort(farthest.T[::-1])[-1]]
    return found


class _At:
    """Values at the point that lay somewhere at rest, found on one rank and told to all."""

    def __init__(self, place: str | None) -> None:
        self._place = None if place is None else np.array(place.split(","), dtype=float)

    def cell(self, run: Finished) -> tuple[Array, int]:
        """The point, padded to three coordinates, and a cell that it lies in; -1 elsewhere."""
        msh = run.simulation.body.mesh
        point = tip(run.simulation) if self._place is None else self._place
        d = msh.geometry.dim
        if point.shape != (d,):
            raise MeasureError(f"the point {_told(point)} must have {d} coordinates")
        padded = np.zeros(3)
        padded[:d] = point
        owned = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)
        tree = geometry.bb_tree(msh, d, padding=1e-9, entities=owned)
        candidates = geometry.compute_collisions_points(tree, padded)
        cells = geometry.compute_colliding_cells(msh, candidates, padded).links(0)
        mine = int(cells[0]) if len(cells) else -1
        owner = msh.comm.allreduce(msh.comm.rank if mine >= 0 else msh.comm.size, MPI.MIN)
        if owner == msh.comm.size:
            raise MeasureError(f"the point {_told(point)} lies outside of the body at rest")
        return padded, mine if msh.comm.rank == owner else -1


class _Coordinate(_At):
    def __init__(self, place: str | None, axis: str) -> None:
        super().__init__(place)
        self._axis = AXES.index(axis)

    def __call__(self, run: Finished) -> float:
        comm = run.simulation.body.mesh.comm
        d = run.simulation.body.mesh.geometry.dim
        if self._axis >= d:
            raise MeasureError(f"the axis {AXES[self._axis]} is not there in {d}D")
        point, cell = self.cell(run)
        value = 0.0
        if cell >= 0:
            moved = run.simulation.model.u.eval(point[None], np.array([cell], dtype=np.int32))
            value = float(point[self._axis] + np.ravel(moved)[self._axis])
        return float(comm.allreduce(value))


class _OfCell(_At):
    def __init__(self, what: str, place: str) -> None:
        super().__init__(place)
        self._what = what

    def __call__(self, run: Finished) -> float:
        mesh, means = run.simulation.body.mesh, run.simulation.cell_means()
        if self._what == "von_mises":
            values = means.von_mises
        else:
            values = np.linalg.norm(means.stretch - np.eye(mesh.geometry.dim), axis=(1, 2))
        _, cell = self.cell(run)
        value = float(values[cell]) if cell >= 0 else 0.0
        return float(mesh.comm.allreduce(value))


def _reaction(number: str, axis: str) -> Measure:
    k, i = int(number) - 1, AXES.index(axis)

    def measured(run: Finished) -> float:
        reactions = run.simulation.account.reactions
        if not (0 <= k < len(reactions) and i < reactions.shape[1]):
            raise MeasureError(
                f"reaction.{number}.{axis}: the scene has {len(reactions)} [[boundary]], counted "
                f"from 1, in {reactions.shape[1]}D"
            )
        return float(reactions[k, i])

    return measured


def _energy(name: str) -> Measure:
    def measured(run: Finished) -> float:
        energies, done = run.simulation.energies(), run.simulation.account.balance
        more = {"dissipated": done.dissipated, "missing": done.missing(run.start, energies)}
        return float((energies._asdict() | more)[name])

    return measured


def _work(name: str) -> Measure:
    return lambda run: float(getattr(run.simulation.account.balance, name))


def _iterations(most: str | None) -> Measure:
    def measured(run: Finished) -> float:
        iterations = [result.iterations for result in run.results]
        return float(max(iterations, default=0) if most else sum(iterations))

    return measured


def _seconds() -> Measure:
    def measured(run: Finished) -> float:
        total = sum(result.timings["total"] for result in run.results)
        return float(run.simulation.body.mesh.comm.allreduce(total, MPI.MAX))

    return measured


_MEASURES: tuple[tuple[str, Callable[..., Measure]], ...] = (
    (r"tip\.([xyz])", lambda axis: _Coordinate(None, axis)),
    (rf"at{PLACE}\.([xyz])", _Coordinate),
    (rf"(von_mises|strain){PLACE}", _OfCell),
    (r"reaction\.(\d+)\.([xyz])", _reaction),
    (r"energy\.(kinetic|elastic|potential|dissipated|missing)", _energy),
    (r"work\.(loads|motions)", _work),
    (r"iterations(\.most)?", _iterations),
    (r"krylov", lambda: lambda run: float(sum(r.krylov_iterations for r in run.results))),
    (r"seconds", _seconds),
)


def _told(point: Array) -> str:
    return f"({', '.join(f'{x:g}' for x in point)})"
