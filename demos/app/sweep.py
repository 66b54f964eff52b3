"""`mixed-fem sweep`: a scene over a grid of its settings, measured, and whether that settles.

A sweep is a study whose cases are runs of one scene: it is kept and resumed as studies are.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from demos.app.measures import Finished, MeasureError, measure
from demos.app.scene import Overrides, as_tables, build, read_text
from demos.app.simulation import Simulation, build_body
from demos.app.tables import SceneError
from demos.studies.records import Record, aligned
from demos.studies.richardson import Convergence, convergence
from demos.studies.study import Parameters, Study
from solvers import ConvergenceError, SolveResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZES = {"mesh.refine": lambda n: 2.0**-n, "mesh.h": float, "time.h": float}
"""What grows finer with a key, as a length or a time up to a factor."""


@dataclass(frozen=True)
class Axis:
    """A setting and the values that it takes.

    Attributes:
        key: Its place in the scene, such as "time.h", or "material.2.E" in the second of several.
        values: What to put there.
    """

    key: str
    values: tuple[Any, ...]


def axis(text: str) -> Axis:
    """Read what the command line says, such as "mesh.refine=0:3" or "time.h=0.1,0.05".

    Raises:
        SceneError: It says something else.
    """
    key, equals, listed = text.partition("=")
    key = key.strip()
    if not (equals and key and listed.strip()):
        raise SceneError(f"--vary {text}: must be written as KEY=VALUE,VALUE,... or KEY=FIRST:LAST")
    first, colon, last = listed.partition(":")
    if colon and _is_whole(first) and _is_whole(last):
        values = tuple(range(int(first), int(last) + 1))
    else:
        values = tuple(_value(word.strip()) for word in listed.split(","))
    words = set(map(str, values))
    if not values or len(words) < len(values) or "" in words:
        raise SceneError(f"--vary {text}: needs values, each once")
    return Axis(key, values)


def _is_whole(word: str) -> bool:
    return word.strip().lstrip("-").isdigit()


def _value(word: str) -> Any:
    """A value as TOML has it; what is none is a text."""
    try:
        return tomllib.loads(f"value = {word}")["value"]
    except tomllib.TOMLDecodeError:
        return word


def sweep(comm: MPI.Comm, scene: str, axes: Sequence[Axis], measures: Sequence[str]) -> Study:
    """The study that a sweep is, every case of it checked. Collective.

    Args:
        comm: Communicator.
        scene: Name of a built-in scene, or path of a TOML file.
        axes: What to vary; the first grows slowest.
        measures: What to measure of each run, see `demos.app.measures`.

    Raises:
        SceneError: The scene is not valid with some of the values.
        MeasureError: There is no such measure.
    """
    for name in measures:
        measure(name)
    keys = [one.key for one in axes]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise SceneError(f"--vary {twice[0]}: given twice")
    text, path = read_text(comm, scene)
    tables = as_tables(text, scene)
    cases: list[Parameters] = []
    files: set[Path] = set()
    for values in itertools.product(*(one.values for one in axes)):
        chosen = dict(zip(keys, values, strict=True))
        ready = build(_changed(tables, chosen, scene), path, Overrides(), scene)
        files |= {ready.mesh.file} if ready.mesh.file else set()
        cases.append(chosen)
    return Study(
        name=f"sweep-{path.stem}",
        description=f"a sweep of {scene}",
        grid=lambda quick: cases,
        compute=partial(compute, scene=scene, text=text, path=path, measures=tuple(measures)),
        table=partial(table, axes=axes, measures=measures),
        draw=partial(draw, axes=axes, measures=measures),
        verdict=lambda records: [
            f"{_told(r, keys)}: {r['failure']}" for r in records if r["failure"]
        ],
        depends=comm.bcast(_digest(text, sorted(files), measures) if comm.rank == 0 else ""),
    )


def _digest(text: str, files: Sequence[Path], measures: Sequence[str]) -> str:
    """What the records depend on beside the sources and the settings."""
    digest = hashlib.sha256(repr((text, list(measures))).encode())
    for file in files:
        try:
            digest.update(file.read_bytes())
        except OSError:
            continue  # the run says what is wrong with it
    return digest.hexdigest()


def _changed(tables: Mapping[str, Any], chosen: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The tables of a scene with settings put into them.

    With another time step and no other number of steps, the end of the run stays.
    """
    changed = copy.deepcopy(dict(tables))
    for key, value in chosen.items():
        _table(changed, key, source)[key.rpartition(".")[2]] = value
    if "time.h" in chosen and "time.steps" not in chosen:
        steps = _steps(tables, chosen["time.h"], source)
        if steps is not None:
            changed["time"]["steps"] = steps
    return changed


def _table(tables: dict[str, Any], key: str, source: str) -> dict[str, Any]:
    """The table of a scene that a setting belongs to; one that is not there is made.

    Raises:
        SceneError: There is no such place, or there are several.
    """
    *path, last = key.split(".")
    place: Any = tables
    for k, word in enumerate(path):
        place = place.setdefault(word, {}) if isinstance(place, dict) else _entry(place, word)
        if isinstance(place, list) and len(place) == 1 and k == len(path) - 1:
            place = place[0]
        if not isinstance(place, dict | list) or place == []:
            raise SceneError(f"{source}: --vary {key}: there is no {'.'.join(path[: k + 1])}")
    if not isinstance(place, dict):
        raise SceneError(
            f"{source}: --vary {key}: there are {len(place)} [[{path[-1]}]]; say which, "
            f"{'.'.join(path)}.1.{last} to {'.'.join(path)}.{len(place)}.{last}"
        )
    return place


def _steps(tables: Mapping[str, Any], h: Any, source: str) -> int | None:
    """The number of steps of h [s] to the end of a scene; None where it does not say its end.

    Raises:
        SceneError: h does not divide its time.
    """
    before: Any = tables.get("time")
    try:
        steps = before["steps"] * before["h"] / h
    except (KeyError, TypeError, ZeroDivisionError):
        return None  # the check of the scene says what is wrong
    if not (math.isfinite(steps) and steps > 0 and abs(steps - round(steps)) < 1e-6 * steps):
        raise SceneError(
            f"{source}: --vary time.h={h}: does not divide the {before['steps']} steps "
            f"of {before['h']} s"
        )
    return round(steps)


def _entry(place: list[Any], word: str) -> Any:
    """The entry of an array of tables, counted from 1."""
    return place[int(word) - 1] if word.isdigit() and 0 < int(word) <= len(place) else None


def compute(
    comm: MPI.Comm,
    parameters: Parameters,
    scene: str,
    text: str,
    path: Path,
    measures: Sequence[str],
) -> Record:
    """Run a case and measure. Collective."""
    ready = build(_changed(as_tables(text, scene), parameters, scene), path, Overrides(), scene)
    body = build_body(ready, comm)
    simulation = Simulation(ready, body)
    results: list[SolveResult] = []
    run = Finished(simulation, results, simulation.energies())
    _measured(run, measures, scene)  # before what takes long
    failure = ""
    try:
        results += simulation.march(ready.steps)
    except ConvergenceError as error:
        failure = f"t = {simulation.scheme.t:g} s: {error.result.reason}"
    dofmap = simulation.model.u.function_space.dofmap
    found: Record = {"cells": body.num_cells}
    found["dofs"] = int(dofmap.index_map.size_global * dofmap.index_map_bs)
    values = _measured(run, measures, scene)
    return {**found, **(dict.fromkeys(values) if failure else values), "failure": failure}


def _measured(run: Finished, measures: Sequence[str], scene: str) -> dict[str, float]:
    values = {}
    for name in measures:
        try:
            values[name] = measure(name)(run)
        except MeasureError as error:
            raise SceneError(f"{scene}: --measure {name}: {error}") from error
    return values


# What it shows


@dataclass(frozen=True)
class Series:
    """Runs that differ in one setting that makes them finer.

    Attributes:
        key: That setting.
        others: The settings that they share, in words.
        records: The runs that did not fail, from coarse to fine.
        sizes: Their sizes.
    """

    key: str
    others: str
    records: list[Record]
    sizes: list[float]

    def judged(self, name: str) -> Convergence:
        """What the values of a measure say."""
        return convergence(self.sizes, [r[name] for r in self.records])


def series(records: Sequence[Record], axes: Sequence[Axis]) -> list[Series]:
    """Those along each setting that makes runs finer."""
    found = []
    for along in (one for one in axes if one.key in SIZES and len(one.values) > 1):
        others = [one.key for one in axes if one is not along]
        grouped: dict[str, list[Record]] = {}
        for r in records:
            if not r["failure"]:
                grouped.setdefault(_told(r, others), []).append(r)
        for told, group in grouped.items():
            size = SIZES[along.key]
            group = sorted(group, key=lambda r: -size(r[along.key]))
            found.append(Series(along.key, told, group, [size(r[along.key]) for r in group]))
    return found


def table(records: Sequence[Record], axes: Sequence[Axis], measures: Sequence[str]) -> list[str]:
    """The measures of each run, then what each series of finer runs says of each."""
    columns = [*(one.key for one in axes), "cells", *measures]
    rows = [columns]
    for r in records:
        shown = [_shown(r[name]) for name in columns]
        rows.append([*shown, f"fails: {r['failure']}"] if r["failure"] else shown)
    heading = ["measure", "over", "at", "order", "extrapolated", "finest is within", ""]
    judged = [heading]
    for one in series(records, axes):
        for name in measures:
            if name.partition(".")[0] in ("seconds", "iterations", "krylov"):
                continue  # grow without a limit
            c = one.judged(name)
            numbers = [_shown(x) for x in (c.order, c.limit, c.index)]
            judged.append([name, one.key, one.others, f"{c.order:.2f}", *numbers[1:], c.remark])
    lines = aligned([[*row, ""] if k == 0 else row for k, row in enumerate(rows)])
    return ["", *lines] + (["", *aligned(judged)] if len(judged) > 1 else [])


def draw(
    records: Sequence[Record], figure: Figure, axes: Sequence[Axis], measures: Sequence[str]
) -> None:
    """Each measure over what grows finer, with error bars and the extrapolation; else over runs."""
    found = series(records, axes) or [_over_runs(records, axes)]
    keys = list(dict.fromkeys(one.key for one in found))
    figure.set_size_inches(4.5 * len(measures), 3.5 * len(keys))
    plots = figure.subplots(len(keys), len(measures), squeeze=False)
    for one in found:
        for plot, name in zip(plots[keys.index(one.key)], measures, strict=True):
            values = [r[name] for r in one.records]
            c = one.judged(name)
            (line,) = plot.plot(one.sizes, values, "o-", label=one.others or None)
            if not math.isnan(c.limit):
                plot.errorbar(one.sizes[-1:], values[-1:], c.index, color=line.get_color())
                plot.plot(0.0, c.limit, "x", color=line.get_color())
            plot.set(xlabel=one.key if one.key != "mesh.refine" else "size of cells", ylabel=name)
            plot.grid(alpha=0.3)
    if any(one.others for one in found):
        plots[0][0].legend(fontsize=7)


def _over_runs(records: Sequence[Record], axes: Sequence[Axis]) -> Series:
    done = [r for r in records if not r["failure"]]
    key = axes[0].key
    numbers = all(isinstance(r[key], int | float) for r in done)
    return Series(
        key, "", done, [float(r[key]) if numbers else float(k) for k, r in enumerate(done)]
    )


def _told(record: Mapping[str, Any], keys: Sequence[str]) -> str:
    return ", ".join(f"{key} = {record[key]}" for key in keys)


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.7g}" if isinstance(value, float) else str(value)
