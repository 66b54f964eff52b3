"""`mixed-fem run`: a scene from its file to results on disk, and its baseline beside it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import mesh

from demos.app import viewer
from demos.app.about import about, differences
from demos.app.fields import as_mesh
from demos.app.files import make_folder
from demos.app.output import CHECKPOINT, Output
from demos.app.progress import Screen, duration
from demos.app.scene import Scene
from demos.app.simulation import Simulation, build_body
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


@dataclasses.dataclass(frozen=True)
class Run:
    """What a formulation made of a scene.

    Attributes:
        formulation: Its name.
        results: One for each step that it made, the failed one included.
        before: How many steps it found made.
        failure: What to say if the last of them failed, else nothing.
        state: The final state on rank 0, see `demos.app.output.final_state`.
    """

    formulation: str
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
) -> list[str]:
    """Run a scene, write its results, draw it, and run its baseline if it has one. Collective.

    Args:
        scene: What to run.
        comm: Communicator.
        out: Folder for the results; those of the baseline go to a folder in it.
        screen: Where to report.
        restart: Checkpoints.

    Returns:
        A message for each solve that failed. What was computed before the failure is on disk.

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
    main = _march(scene, body, scene.formulation, out, screen, restart, told)
    if main.state is not None and main.state["t"] > 0:
        _draw(main.state, out, screen)
    runs = [main]
    if scene.baseline is not None and scene.baseline != scene.formulation:
        beside = dataclasses.replace(restart, file=None)
        baseline = _march(scene, body, scene.baseline, out / scene.baseline, screen, beside, told)
        runs.append(baseline)
        for line in comparison(scene, main, baseline):
            screen.line(line)
    comm.barrier()  # rank 0 is still writing when the others have nothing left to do
    return [r.failure for r in runs if r.failure]


def _march(
    scene: Scene,
    body: Body,
    formulation: str,
    out: Path,
    screen: Screen,
    restart: Restart,
    told: Mapping[str, Any],
) -> Run:
    comm = body.mesh.comm
    saved = _saved(comm, out, formulation, told["scene"], screen, restart)
    screen.line(f"{formulation}: preparing forms (the first time compiles them, about 15 s in 3D)")
    start = time.perf_counter()
    simulation = Simulation(scene, body, formulation)
    if saved is not None:
        saved.put(body, simulation.model, simulation.scheme)
    results: list[SolveResult] = []
    failure = ""
    with deferred():
        output = Output(out, simulation, told, saved)
        begun = "" if saved is None else f", goes on after step {output.steps}"
        screen.line(f"{formulation}: ready after {time.perf_counter() - start:.1f} s{begun}")
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
                screen.progress(formulation, output.steps, scene.steps, told_step)
                if restart.every and output.steps % restart.every == 0:
                    output.checkpoint()
                safe_point(comm)
        except ConvergenceError as error:
            results.append(error.result)
            output.iterations(error.result)
            failure = (
                f"{formulation}: step {output.steps + 1} of {scene.steps} failed, the state at t = "
                f"{simulation.scheme.t:g} s is kept in {out}: {error}"
            )
        except FloatingPointError as error:
            failure = f"{formulation}: step {output.steps + 1} of {scene.steps} failed: {error}"
        except KeyboardInterrupt as error:
            output.checkpoint()
            output.final()
            error.args = (
                f"{formulation}: {output.steps} of {scene.steps} steps are done and kept in {out}; "
                "the same command with --resume goes on",
            )
            raise
        output.checkpoint()
        state = output.final()
    screen.line(f"{formulation}: results in {out}")
    return Run(formulation, tuple(results), before, failure, state)


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


def comparison(scene: Scene, main: Run, baseline: Run) -> list[str]:
    """A table of Newton iterations and seconds a step for two formulations, in lines."""
    runs = (main, baseline)
    lines = [
        "",
        f"{'':>6}  " + "  ".join(f"{r.formulation:^21}" for r in runs),
        f"{'step':>6}  " + "  ".join(f"{'Newton':>10} {'seconds':>10}" for _ in runs),
    ]
    for k in range(scene.steps):
        lines.append(f"{k + 1:>6}  " + "  ".join(_cell(r, k) for r in runs))
    totals = [
        f"{sum(s.iterations for s in r.results):>10} "
        f"{sum(s.timings['total'] for s in r.results):>10.3f}"
        for r in runs
    ]
    lines.append(f"{'total':>6}  " + "  ".join(totals))
    if (
        main.state is not None
        and baseline.state is not None
        and not (main.failure or baseline.failure)
    ):
        difference = np.abs(main.state["x"] - baseline.state["x"]).max()
        lines.append(f"largest difference of a final coordinate: {difference:.1e} m")
    return lines


def _cell(run: Run, step: int) -> str:
    step -= run.before
    if not 0 <= step < len(run.results):
        return f"{'-':>10} {'-':>10}"
    result = run.results[step]
    iterations = f"{result.iterations}"
    if run.failure and step == len(run.results) - 1:
        iterations = f"fails ({iterations})"
    return f"{iterations:>10} {result.timings['total']:>10.3f}"


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
