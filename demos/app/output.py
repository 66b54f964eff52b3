"""What a run leaves on disk. Arrays are gathered to rank 0 in the order of the mesh file."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from mpi4py import MPI

import meshio
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.io import VTKFile

from demos.app.simulation import Simulation
from forms import Energies
from forms.points import is_simplicial
from meshes import VTK_ORDER, Body
from solvers import SolveResult

_STEP = ("step", "time", "newton_iterations", "krylov_iterations")
_ENERGIES = ("kinetic_energy", "elastic_energy", "potential_energy")
_WORKS = ("work_of_loads", "work_of_motions", "dissipated_energy", "missing_energy")
_SECONDS = ("seconds_assembly", "seconds_condensation", "seconds_solve")

Array = npt.NDArray[Any]


class OutputError(OSError):
    """The output folder cannot be used; the message is one line."""


class Output:
    """The files of one run, written as the run goes; a context manager.

    - ``history.csv``: a row a step, on disk when the step is done: iterations, residuals, energies
      [J], works of loads and motions and what damping has taken since the start [J], what of the
      two the body has not [J], the force of each [[boundary]] on it [N], seconds.
    - ``newton.csv``: a row a Newton iteration, the starting point being iteration 0.
    - ``fields/fields.pvd``: displacement u [m], |S - I| and von Mises stress [Pa] of each step, for
      ParaView.
    - ``final.npz``: see `final_state`.

    Files of a former run are removed from the folder, others are left alone.
    """

    def __init__(self, folder: Path, simulation: Simulation) -> None:
        """Clear the folder and open the files. Collective.

        Raises:
            OutputError: On all ranks: the folder cannot be written to.
        """
        self.folder = folder
        self.simulation = simulation
        self._comm = simulation.body.mesh.comm
        self._step = 0
        names = [f.name for f in simulation.fields]
        residuals = [f"residual_{name}" for name in names]
        motions, d = simulation.account.reactions.shape
        reactions = [f"reaction_{k + 1}_{axis}" for k in range(motions) for axis in "xyz"[:d]]
        at_first = simulation.energies()
        self._mechanical_at_first = at_first.kinetic + at_first.elastic
        self._names = names
        make_folder(self._comm, folder / "fields")
        _on_rank_0(self._comm, folder, lambda: _remove_former_results(folder))
        self._history = _Csv(
            self._comm,
            folder / "history.csv",
            [*_STEP, *residuals, *_ENERGIES, *_WORKS, *reactions, *_SECONDS],
        )
        self._newton = _Csv(
            self._comm, folder / "newton.csv", ["step", "iteration", "residual", *residuals, "note"]
        )
        self._at_vertices = _AtVertices(simulation.fields[0])
        on_cells = fem.functionspace(simulation.body.mesh, ("DG", 0))
        self._strain = fem.Function(on_cells, name="|S - I|")
        self._von_mises = fem.Function(on_cells, name="von Mises stress")
        self._vtk = VTKFile(self._comm, str(folder / "fields" / "fields.pvd"), "w")
        self._write_fields()

    def __enter__(self) -> Output:
        """Return self."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the files."""
        self._vtk.close()
        self._history.close()
        self._newton.close()

    def step(self, result: SolveResult, energies: Energies) -> None:
        """Record a step that has been solved and advanced. Collective."""
        self.iterations(result)
        self._step += 1
        seconds = result.timings
        done = self.simulation.account.balance
        gained = energies.kinetic + energies.elastic - self._mechanical_at_first
        missing = done.loads + done.motions - done.dissipated - gained
        self._history.row(
            [
                *(self._step, self.simulation.scheme.t),
                *(result.iterations, result.krylov_iterations),
                *(result.norms[-1][name] for name in self._names),
                *(energies.kinetic, energies.elastic, energies.potential),
                *(done.loads, done.motions, done.dissipated, missing),
                *self.simulation.account.reactions.ravel(),
                seconds["residual"] + seconds["jacobian"],
                seconds.get("condensation", 0.0),
                seconds.get("setup", 0.0) + seconds["solve"],
            ]
        )
        self._write_fields()

    def iterations(self, result: SolveResult) -> None:
        """Record the Newton iterations of the step under way, finished or failed."""
        for k, (norms, norm) in enumerate(zip(result.norms, result.residuals, strict=True)):
            values = (norms[name] for name in self._names)
            self._newton.row([self._step + 1, k, norm, *values, result.notes.get(k, "")])

    def final(self) -> dict[str, Array] | None:
        """Write the state reached to ``final.npz``; return it on rank 0. Collective."""
        state = final_state(self.simulation)
        if state is not None:
            np.savez_compressed(self.folder / "final.npz", **state)  # type: ignore[arg-type]
        return state

    def _write_fields(self) -> None:
        space = self._strain.function_space
        cells = space.dofmap.list[: len(self.simulation.body.file_cells)].ravel()
        strain = self.simulation.stretch() - np.eye(self.simulation.body.mesh.geometry.dim)
        self._strain.x.array[cells] = np.linalg.norm(strain, axis=(1, 2))
        self._von_mises.x.array[cells] = self.simulation.von_mises()
        for f in (self._strain, self._von_mises):
            f.x.scatter_forward()
        u = self._at_vertices.values()
        self._vtk.write_function([u, self._strain, self._von_mises], self.simulation.scheme.t)


def final_state(simulation: Simulation) -> dict[str, Array] | None:
    """The state reached, on rank 0 in the order of the mesh file. Collective.

    Returns:
        On rank 0 ``X`` and ``x``, rest and present positions [m], and ``v``, velocity [m/s], of
        shape (vertices, d); ``S``, right stretch, and ``Lam``, first Piola-Kirchhoff stress [Pa],
        of shape (cells, d, d); ``von_mises``, that stress [Pa], of shape (cells,); ``cells``,
        vertex numbers, of simplices of shape (cells, d + 1) with each row in ascending order, else
        in the order of VTK; ``t``, the time [s]. S and both stresses are means over the cell.
        None on other ranks.
    """
    body, scheme = simulation.body, simulation.scheme
    X = body.gather_points()
    u, v = body.gather(simulation.fields[0]), body.gather(scheme.v)
    of_cells = {
        name: body.gather(values)
        for name, values in (
            ("S", simulation.stretch()),
            ("Lam", simulation.stress()),
            ("von_mises", simulation.von_mises()),
            ("cells", _vtk_cells(body)),
        )
    }
    if X is None or u is None or v is None:
        return None
    cells = {name: values for name, values in of_cells.items() if values is not None}
    return {"X": X, "x": X + u, "v": v, **cells, "t": np.array(scheme.t)}


class _AtVertices:
    """A continuous function interpolated by a piecewise (multi)linear one."""

    def __init__(self, function: fem.Function[Any]) -> None:
        self._function = self._linear = function
        if function.function_space.element.basix_element.degree > 1:
            shape = function.ufl_shape
            space = fem.functionspace(function.function_space.mesh, ("P", 1, shape))
            self._linear = fem.Function(space, name=function.name)

    def values(self) -> fem.Function[Any]:
        if self._linear is not self._function:
            self._linear.interpolate(self._function)
        return self._linear


def _vtk_cells(body: Body) -> Array:
    """Vertices of the owned cells in the order of VTK, or sorted where any order will do."""
    cells = body.file_connectivity()
    if is_simplicial(body.mesh):
        return np.sort(cells)
    return cells[:, VTK_ORDER[body.mesh.topology.cell_type]]


def make_folder(comm: MPI.Comm, folder: Path) -> None:
    """Make a folder for results, before anything long is begun. Collective.

    Raises:
        OutputError: On all ranks: the folder cannot be made or written to.
    """
    _on_rank_0(comm, folder, lambda: folder.mkdir(parents=True, exist_ok=True))


def _remove_former_results(folder: Path) -> None:
    names = ("final.npz", "history.csv", "newton.csv", "picture.png", "picture.vtu")
    former = [folder / name for name in names]
    for path in [*former, *(folder / "fields").glob("fields*.*vt[ud]")]:
        path.unlink(missing_ok=True)


def _on_rank_0(comm: MPI.Comm, folder: Path, action: Callable[[], None]) -> None:
    error = None
    if comm.rank == 0:
        try:
            action()
            if not os.access(folder, os.W_OK | os.X_OK):
                error = "Permission denied"
        except OSError as e:
            error = e.strerror
    error = comm.bcast(error)
    if error is not None:
        raise OutputError(f"--out {folder}: cannot be written to ({error})")


def write_surface(path: Path, state: Mapping[str, Array]) -> None:
    """Write a gathered state as a VTK file: present positions with |S - I| on the cells."""
    d = state["X"].shape[1]
    points = np.zeros((len(state["x"]), 3))
    points[:, :d] = state["x"]
    strain = np.linalg.norm(state["S"] - np.eye(d), axis=(1, 2))
    kind = {(2, 3): "triangle", (2, 4): "quad", (3, 4): "tetra", (3, 8): "hexahedron"}[
        d, state["cells"].shape[1]
    ]
    meshio.Mesh(points, [(kind, state["cells"])], cell_data={"|S - I|": [strain]}).write(path)


class _Csv:
    """A table on disk, complete after every row; exists on rank 0."""

    def __init__(self, comm: MPI.Comm, path: Path, columns: Sequence[str]) -> None:
        self._file: io.TextIOWrapper | None = None
        if comm.rank == 0:
            self._file = path.open("w", newline="", encoding="utf-8")
        self.row(columns)

    def row(self, values: Sequence[object]) -> None:
        if self._file is not None:
            csv.writer(self._file).writerow(values)
            self._file.flush()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
