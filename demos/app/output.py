"""What a run leaves on disk. Arrays are gathered to rank 0 in the order of the mesh file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from demos.app.fields import Series
from demos.app.files import (
    ABOUT,
    Csv,
    OutputError,
    cannot_write,
    claim,
    make_folder,
    on_rank_0,
)
from demos.app.simulation import Simulation
from forms import Balance, Energies
from solvers import Checkpoint, SolveResult, checkpoint
from solvers.files import write_whole

_STEP = ("step", "time", "newton_iterations", "krylov_iterations")
_ENERGIES = ("kinetic_energy", "elastic_energy", "potential_energy")
_WORKS = ("work_of_loads", "work_of_motions", "dissipated_energy", "missing_energy")
_SECONDS = ("seconds_assembly", "seconds_condensation", "seconds_solve")

CHECKPOINT = "checkpoint.npz"
NAMES = ("final.npz", "history.csv", "newton.csv", "picture.png", "picture.vtu", CHECKPOINT)

Array = npt.NDArray[Any]


class Output:
    """The files of one run, written as the run goes.

    - ``run.json``: what was run, and by what.
    - ``history.csv``: a row a step, on disk when the step is done: iterations, residuals, energies
      [J], works of loads and motions and what damping has taken since the start [J], what of the
      two the body has not [J], the force of each [[boundary]] on it [N], seconds.
    - ``newton.csv``: a row a Newton iteration, the starting point being iteration 0.
    - ``fields/fields.pvd``: displacement u [m], velocity v [m/s], S, R, P and von Mises stress
      [Pa], |S - I| and tags of each step, for ParaView; each file by itself for meshio.
    - ``checkpoint.npz``: what `mixed-fem run --resume` goes on from.
    - ``final.npz``: see `final_state`.

    Those of a former run are removed from the folder, others are left alone.

    Attributes:
        folder: Where they are.
        steps: How many are done.
    """

    def __init__(
        self,
        folder: Path,
        simulation: Simulation,
        about: Mapping[str, Any],
        resumed: Checkpoint | None = None,
    ) -> None:
        """Clear the folder and begin the files. Collective.

        Args:
            folder: Where to write.
            simulation: What is run.
            about: What goes into ``run.json``.
            resumed: The checkpoint in whose state the simulation is, or None at the start.

        Raises:
            OutputError: On all ranks: the folder cannot be written to, or has files that this
                program has not written.
        """
        self.folder, self.simulation = folder, simulation
        self._about = {"scene": about["scene"], "formulation": simulation.model.form.name}
        self._comm = simulation.body.mesh.comm
        self._names = [f.name for f in simulation.fields]
        residuals = [f"residual_{name}" for name in self._names]
        motions, d = simulation.account.reactions.shape
        reactions = [f"reaction_{k + 1}_{axis}" for k in range(motions) for axis in "xyz"[:d]]
        make_folder(self._comm, folder / "fields")
        on_rank_0(self._comm, folder, lambda: claim(folder, NAMES, _STEP))
        self._start = simulation.energies()
        self.steps, times, self._kept = 0, [], -1
        if resumed is not None:
            more = resumed.more
            self.steps, times = more["step"], more["times"]
            self._start = Energies(*more["start"])
            simulation.account.balance = Balance(*more["balance"])
            simulation.account.reactions = np.array(more["reactions"]).reshape(motions, d)
            simulation.pace.begin, simulation.pace.h = more["pace"]
            simulation.problem.carry(more["carried"])
            self._kept = self.steps
        else:
            on_rank_0(self._comm, folder, lambda: _remove(folder))
        told = {**about, "formulation": simulation.model.form.name}
        on_rank_0(self._comm, folder, lambda: _write_json(folder / ABOUT, told))
        kept = None if resumed is None else self.steps
        columns = [*_STEP, *residuals, *_ENERGIES, *_WORKS, *reactions, *_SECONDS]
        self._history = Csv(self._comm, folder / "history.csv", columns, kept)
        columns = ["step", "iteration", "residual", *residuals, "note"]
        self._newton = Csv(self._comm, folder / "newton.csv", columns, kept)
        self._fields = Series(self._comm, folder / "fields", times)
        if resumed is None:
            self._fields.write(final_state(simulation), simulation.scheme.t)
            self.checkpoint()

    def step(self, result: SolveResult) -> None:
        """Record a step that has been solved and advanced. Collective."""
        self.iterations(result)
        self.steps += 1
        seconds, account = result.timings, self.simulation.account
        energies, done = self.simulation.energies(), account.balance
        self._history.row(
            [
                *(self.steps, self.simulation.scheme.t),
                *(result.iterations, result.krylov_iterations),
                *(result.norms[-1][name] for name in self._names),
                *(energies.kinetic, energies.elastic, energies.potential),
                *(*done, done.missing(self._start, energies)),
                *account.reactions.ravel(),
                seconds["residual"] + seconds["jacobian"],
                seconds.get("condensation", 0.0),
                seconds.get("setup", 0.0) + seconds["solve"],
            ]
        )
        self._fields.write(final_state(self.simulation), self.simulation.scheme.t)

    def iterations(self, result: SolveResult) -> None:
        """Record the Newton iterations of the step under way, finished or failed. Collective."""
        for k, (norms, norm) in enumerate(zip(result.norms, result.residuals, strict=True)):
            numbers = [norm, *(norms[name] for name in self._names)]
            told = [number if np.isfinite(number) else "" for number in numbers]
            self._newton.row([self.steps + 1, k, *told, result.notes.get(k, "")])

    def checkpoint(self) -> None:
        """Write what a later run can go on from, to the last bit. Collective.

        Raises:
            OutputError: On all ranks: it cannot be written; the former one is as it was.
        """
        if self._kept == self.steps:
            return
        simulation, account = self.simulation, self.simulation.account
        pace = simulation.pace
        file = self.folder / CHECKPOINT
        try:
            checkpoint.save(
                file,
                simulation.body,
                simulation.model,
                simulation.scheme,
                **self._about,
                step=self.steps,
                times=self._fields.times,
                start=list(self._start),
                balance=list(account.balance),
                reactions=account.reactions.tolist(),
                pace=[pace.begin, pace.h],
                carried=simulation.problem.carried(),
            )
        except OSError as e:
            raise OutputError(cannot_write(file, e)) from e
        self._kept = self.steps

    def final(self) -> dict[str, Array] | None:
        """Write the state reached to ``final.npz``; return it on rank 0. Collective."""
        state = final_state(self.simulation)

        def write() -> None:
            assert state is not None
            kept = {name: state[name] for name in state if name not in ("R", "psi", "tags")}
            write_whole(
                self.folder / "final.npz",
                lambda path: np.savez_compressed(path, **kept),  # type: ignore[arg-type]
            )

        on_rank_0(self._comm, self.folder, write)
        return state


def final_state(simulation: Simulation) -> dict[str, Array] | None:
    """The state reached, on rank 0 in the order of the mesh file. Collective.

    Returns:
        On rank 0 ``X`` and ``x``, rest and present positions [m], and ``v``, velocity [m/s], of
        shape (vertices, d); ``S``, right stretch, and ``Lam``, first Piola-Kirchhoff stress [Pa],
        of shape (cells, d, d); ``R``, rotation, likewise; ``von_mises``, that stress [Pa],
        ``psi``, strain energy density [J/m³], and ``tags``, of shape (cells,); ``cells``,
        vertex numbers, of simplices of shape (cells, d + 1) with each row in ascending order, else
        in the order of VTK; ``t``, the time [s]. S and both stresses are means over the cell.
        None on other ranks.
    """
    body, scheme = simulation.body, simulation.scheme
    X, *lists = simulation.at_rest
    u, v = body.gather(simulation.fields[0]), body.gather(scheme.v)
    means = simulation.cell_means()
    of_cells = {
        name: body.gather(values)
        for name, values in (
            ("S", means.stretch),
            ("Lam", means.stress),
            ("R", _rotations(means.gradient)),
            ("von_mises", means.von_mises),
            ("psi", means.energy_density),
        )
    } | dict(zip(("tags", "cells"), lists, strict=True))
    if X is None or u is None or v is None:
        return None
    cells = {name: values for name, values in of_cells.items() if values is not None}
    return {"X": X, "x": X + u, "v": v, **cells, "t": np.array(scheme.t)}


def _rotations(F: Array) -> Array:
    """R of F = R S, in SO(d), shape (n, d, d)."""
    U, _, Vt = np.linalg.svd(F)
    U[np.linalg.det(U @ Vt) < 0.0, :, -1] *= -1.0
    rotations: Array = U @ Vt
    return rotations


def _remove(folder: Path) -> None:
    for name in NAMES:
        (folder / name).unlink(missing_ok=True)


def _write_json(path: Path, about: Mapping[str, Any]) -> None:
    text = json.dumps(about, indent=1, ensure_ascii=False)
    write_whole(path, lambda partial: partial.write_text(text, "utf-8"))
