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

from demos.app import picture
from demos.app.output import Output, make_folder, write_surface
from demos.app.progress import Screen
from demos.app.scene import Scene
from demos.app.simulation import Simulation, build_body
from meshes import Body
from solvers import ConvergenceError, SolveResult

State = Mapping[str, npt.NDArray[Any]]


@dataclasses.dataclass(frozen=True)
class Run:
    """What a formulation made of a scene.

    Attributes:
        formulation: Its name.
        results: One for each step, the failed one included.
        failure: What to say if the last of them failed, else nothing.
        state: The final state on rank 0, see `demos.app.output.final_state`.
    """

    formulation: str
    results: tuple[SolveResult, ...]
    failure: str
    state: State | None


def run(scene: Scene, comm: MPI.Comm, out: Path, screen: Screen) -> list[str]:
    """Run a scene, write its results, draw it, and run its baseline if it has one. Collective.

    Args:
        scene: What to run.
        comm: Communicator.
        out: Folder for the results; those of the baseline go to a folder in it.
        screen: Where to report.

    Returns:
        A message for each solve that failed. What was computed before the failure is on disk.

    Raises:
        SceneError: The scene and its mesh do not fit.
        OutputError: The folder cannot be written to.
    """
    body = build_body(scene, comm)
    make_folder(comm, out)
    screen.line(f"{scene.name}: {_size(body)}, {_parameters(scene)}, h = {scene.h:g} s")
    main = _march(scene, body, scene.formulation, out, screen)
    if main.state is not None and main.state["t"] > 0:
        _draw(scene, body, main.state, out, screen)
    runs = [main]
    if scene.baseline is not None and scene.baseline != scene.formulation:
        baseline = _march(scene, body, scene.baseline, out / scene.baseline, screen)
        runs.append(baseline)
        for line in comparison(scene, main, baseline):
            screen.line(line)
    comm.barrier()  # rank 0 is still writing when the others have nothing left to do
    return [r.failure for r in runs if r.failure]


def _march(scene: Scene, body: Body, formulation: str, out: Path, screen: Screen) -> Run:
    screen.line(f"{formulation}: preparing forms (the first time compiles them, about 15 s in 3D)")
    start = time.perf_counter()
    simulation = Simulation(scene, body, formulation)
    results: list[SolveResult] = []
    failure = ""
    with Output(out, simulation) as output:
        screen.line(f"{formulation}: ready after {time.perf_counter() - start:.1f} s")
        try:
            for result in simulation.march(scene.steps):
                results.append(result)
                output.step(result, simulation.energies())
                screen.progress(formulation, len(results), scene.steps, _told(result))
        except ConvergenceError as error:
            results.append(error.result)
            output.iterations(error.result)
            failure = (
                f"{formulation}: step {len(results)} of {scene.steps} failed, the state at t = "
                f"{simulation.scheme.t:g} s is kept in {out}: {error}"
            )
        state = output.final()
    screen.line(f"{formulation}: results in {out}")
    return Run(formulation, tuple(results), failure, state)


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
    if step >= len(run.results):
        return f"{'-':>10} {'-':>10}"
    result = run.results[step]
    iterations = f"{result.iterations}"
    if run.failure and step == len(run.results) - 1:
        iterations = f"fails ({iterations})"
    return f"{iterations:>10} {result.timings['total']:>10.3f}"


def _draw(scene: Scene, body: Body, state: State, out: Path, screen: Screen) -> None:
    """Only on rank 0, from gathered arrays."""
    parameters = _parameters(scene).replace("nu =", "ν =")
    caption = f"{scene.name}   {parameters}   {_size(body)}   t = {float(state['t']):.3g} s"
    up = [-g for g in scene.gravity]
    reason = picture.draw(out / "final.npz", out / "picture.png", up=up, caption=caption)
    if reason is None:
        screen.line(f"picture: {out / 'picture.png'}")
    else:
        write_surface(out / "picture.vtu", state)
        screen.line(f"no picture ({reason}); the body to draw is in {out / 'picture.vtu'}")


def _told(result: SolveResult) -> str:
    plural = "" if result.iterations == 1 else "s"
    told = f"{result.iterations} Newton iteration{plural}, {result.timings['total']:.2f} s"
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
