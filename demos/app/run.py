"""`mixed-fem run`: a scene from its file to results on disk, and its baselines beside it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import mesh

from demos.app import viewer
from demos.app.about import about, differences
from demos.app.baselines import Baseline
from demos.app.fields import as_mesh
from demos.app.files import make_folder
from demos.app.output import CHECKPOINT, Output
from demos.app.progress import Screen, duration
from demos.app.scene import Scene
from demos.app.simulation import Simulation, build_body
from demos.studies.records import aligned
from meshes import Body
from solvers import (
    Checkpoint,
    CheckpointError,
    ConvergenceError,
    SolveResult,
    checkpoint,
    deferred,
    safe_point,
)

State = Mapping[str, npt.NDArray[Any]]

MOST_COLUMNS = 12
"""Steps that the table shows one by one; of more, only what they come to."""


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """What a method made of a scene.

    Attributes:
        method: Its formulation, and its globalisation if that is not the solver's choice.
        results: One for each step that it made, the failed one included.
        before: How many steps it found made.
        failure: What to say if the last of them failed, else nothing.
        state: The final state on rank 0, see `demos.app.output.final_state`.
    """

    method: str
    results: tuple[SolveResult, ...]
    before: int
    failure: str
    state: State | None


@dataclasses.dataclass(frozen=True)
class Restart:
    """How runs are kept, and gone on with.

    Attributes:
        every: Steps between two checkpoints; 0 for one at the start alone.
        resume: Whether to go on from checkpoints.
        file: The checkpoint to go on from; by default that in the folder of results.
    """

    every: int = 10
    resume: bool = False
    file: Path | None = None


def run(
    scene: Scene, comm: MPI.Comm, out: Path, screen: Screen, restart: Restart = Restart()
) -> str:
    """Run a scene, write its results, draw it, and run its baselines if it has some. Collective.

    Args:
        scene: What to run.
        comm: Communicator.
        out: Folder for the results; those of baselines go to folders in it.
        screen: Where to report.
        restart: Checkpoints.

    Returns:
        What to say if a solve failed, else nothing. What was computed before is on disk. Where a
        baseline fails, the table says so.

    Raises:
        SceneError: The scene and its mesh do not fit.
        CheckpointError: There is nothing that can be gone on from.
        OutputError: The folder cannot be written to, or has other people's files.
        KeyboardInterrupt: By a signal; what is done is on disk, with a checkpoint.
    """
    body = build_body(scene, comm)
    make_folder(comm, out)
    screen.line(f"{scene.name}: {_size(body)}, {_parameters(scene)}, h = {scene.h:g} s")
    told = about(scene, comm) | {
        "caption": f"{scene.name}   {_parameters(scene).replace('nu =', 'ν =')}   {_size(body)}"
    }
    main = _march(scene, body, out, screen, restart, told)
    screen.line(f"{main.method}: results in {out}")
    if main.state is not None and main.state["t"] > 0:
        _draw(main.state, out, screen)
    runs = [main]
    for other in scene.baselines:
        given = dataclasses.replace(
            scene, formulation=other.formulation, globalisation=other.globalisation
        )
        if _method(given) != main.method:
            folder = out / str(other).replace(" ", "-")
            beside = dataclasses.replace(restart, file=None)
            runs.append(_march(given, body, folder, screen, beside, told))
            if runs[-1].failure:
                screen.line(runs[-1].failure.splitlines()[0])
    if len(runs) > 1:
        for line in comparison(runs):
            screen.line(line)
        screen.line(f"seconds of all steps; apart: the farthest final coordinate; results in {out}")
    comm.barrier()  # rank 0 is still writing when the others have nothing left to do
    return main.failure


def _method(scene: Scene) -> str:
    return str(Baseline(scene.formulation, scene.globalisation))


def _march(
    scene: Scene,
    body: Body,
    out: Path,
    screen: Screen,
    restart: Restart,
    told: Mapping[str, Any],
) -> Run:
    comm, method = body.mesh.comm, _method(scene)
    saved = _saved(comm, out, scene.formulation, told["scene"], screen, restart)
    screen.line(f"{method}: preparing forms, which takes seconds the first time")
    start = time.perf_counter()
    simulation = Simulation(scene, body)
    if saved is not None:
        saved.put(body, simulation.model, simulation.scheme)
    results: list[SolveResult] = []
    failure = ""
    with deferred():
        output = Output(out, simulation, told, saved)
        begun = "" if saved is None else f", goes on after step {output.steps}"
        screen.line(f"{method}: ready after {time.perf_counter() - start:.1f} s{begun}")
        before, begin = output.steps, time.perf_counter()
        try:
            for result in simulation.march(scene.steps):
                results.append(result)
                output.step(result)
                done = output.steps - before
                left = (time.perf_counter() - begin) / done * (scene.steps - output.steps)
                told_step = f"t = {simulation.scheme.t:.4g} s, {_told(result)}"
                if left > 0.0:
                    told_step += f", {duration(left)} left"
                screen.progress(method, output.steps, scene.steps, told_step)
                if restart.every and output.steps % restart.every == 0:
                    output.checkpoint()
                safe_point(comm)
        except ConvergenceError as error:
            results.append(error.result)
            output.iterations(error.result)
            failure = (
                f"{method}: step {output.steps + 1} of {scene.steps} failed, the state at t = "
                f"{simulation.scheme.t:g} s is kept in {out}: {error}"
            )
        except FloatingPointError as error:
            failure = f"{method}: step {output.steps + 1} of {scene.steps} failed: {error}"
        except KeyboardInterrupt as error:
            output.checkpoint()
            output.final()
            error.args = (
                f"{method}: {output.steps} of {scene.steps} steps are done and kept in {out}; "
                "the same command with --resume goes on",
            )
            raise
        output.checkpoint()
        state = output.final()
    return Run(method, tuple(results), before, failure, state)


def _saved(
    comm: MPI.Comm,
    out: Path,
    formulation: str,
    scene: Mapping[str, Any],
    screen: Screen,
    restart: Restart,
) -> Checkpoint | None:
    """The checkpoint to go on from, if there is to be one.

    Raises:
        CheckpointError: It is of another scene or formulation, or none.
    """
    if not restart.resume:
        return None
    path = restart.file or out / CHECKPOINT
    if restart.file is None and not comm.bcast(path.exists()):
        screen.line(f"{formulation}: no checkpoint in {out}, begins at the start")
        return None
    saved = checkpoint.read(path, comm)
    if not {"scene", "formulation", "step", "times", "start"} <= set(saved.more):
        raise CheckpointError(f"{path}: no checkpoint of a run")
    if different := differences(saved.more["scene"], scene):
        raise CheckpointError(f"{path}: is of another scene: {different[0]}")
    if saved.more["formulation"] != formulation:
        raise CheckpointError(
            f"{path}: is of the formulation {saved.more['formulation']}, not of {formulation}"
        )
    return saved


def comparison(runs: Sequence[Run]) -> list[str]:
    """A table of the Newton iterations, a line a run, in lines; the first run is what counts."""
    made = {
        run: [r.iterations for r in run.results if r.reason.startswith("CONVERGED")] for run in runs
    }
    steps = max(run.before + len(made[run]) + bool(run.failure) for run in runs)
    each = steps <= MOST_COLUMNS
    heads = [f"{k}" for k in range(1, steps + 1)] if each else ["median", "most"]
    rows = [["Newton iterations of step" if each else "Newton iterations of a step", *heads]]
    rows[0] += ["total", "seconds", "apart [m]"]
    for run in runs:
        counts, last = made[run], "fails" if run.failure else ""
        if each:
            told = ["-"] * run.before + [f"{count}" for count in counts] + [last]
            told = (told + [""] * steps)[:steps]
        elif counts:
            told = [f"{np.median(counts):g}", last or f"{max(counts)}"]
        else:
            told = ["-", last or "-"]
        total = sum(result.iterations for result in run.results)
        seconds = sum(result.timings["total"] for result in run.results)
        rows.append([run.method, *told, f"{total}", f"{seconds:.2f}", _apart(runs[0], run)])
    return ["", *aligned(rows)]


def _apart(first: Run, other: Run) -> str:
    """The largest difference of a final coordinate, where both have come to the end."""
    if other is first or first.failure or other.failure or not (first.state and other.state):
        return ""
    return f"{np.abs(first.state['x'] - other.state['x']).max():.1e}"


def _draw(state: State, out: Path, screen: Screen) -> None:
    """Only on rank 0."""
    reason = viewer.draw(out, out / "picture.png")
    if reason is None:
        screen.line(f"picture: {out / 'picture.png'}")
    else:
        as_mesh(state).write(out / "picture.vtu")
        screen.line(f"no picture ({reason}); the body to draw is in {out / 'picture.vtu'}")


def _told(result: SolveResult) -> str:
    plural = "" if result.iterations == 1 else "s"
    told = (
        f"{result.iterations} Newton iteration{plural}, residual {result.residuals[-1]:.1e}, "
        f"{result.timings['total']:.2f} s"
    )
    return f"{told}, an unstable state: {result.unstable}" if result.unstable else told


def _parameters(scene: Scene) -> str:
    first = scene.regions[0]
    more = f" and {len(scene.regions) - 1} more" if len(scene.regions) > 1 else ""
    return f"{first.name}, E = {first.material.E:g} Pa, nu = {first.material.nu:g}{more}"


_CELLS = {
    mesh.CellType.triangle: "triangles",
    mesh.CellType.quadrilateral: "quadrilaterals",
    mesh.CellType.tetrahedron: "tetrahedra",
    mesh.CellType.hexahedron: "hexahedra",
}


def _size(body: Body) -> str:
    return f"{body.num_cells} {_CELLS[body.mesh.topology.cell_type]}"
