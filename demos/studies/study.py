"""What a study is, and how it runs: cases from a cache or computed, then a table and a figure."""

from __future__ import annotations

import csv
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import forms
import meshes
import solvers
from demos.output import make_folder
from demos.progress import Screen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Parameters = Mapping[str, Any]
Record = dict[str, Any]

_SOURCES = [Path(module.__file__ or "").parent for module in (forms, meshes, solvers)]


@dataclass(frozen=True)
class Study:
    """A grid of cases, a function that computes one, and what to show of them all.

    Attributes:
        name: The name on the command line.
        description: One line.
        grid: The parameters of each case, given whether the study is to be quick. Parameters are
            plain numbers, strings and lists, as JSON has them.
        compute: Computes a case; collective, and the same on all ranks where it matters. Its
            result and the parameters together make up the record of the case, which is plain too.
        table: Lines to show of all records, on rank 0.
        draw: Draws the records into a figure, on rank 0; None if there is nothing to draw.
        verdict: Lines that name what the records fall short of, on rank 0.
        starts_ranks: Whether it starts runs on several ranks by itself, and must be run in serial.
    """

    name: str
    description: str
    grid: Callable[[bool], Sequence[Parameters]]
    compute: Callable[[MPI.Comm, Parameters], Record]
    table: Callable[[Sequence[Record]], list[str]]
    draw: Callable[[Sequence[Record], Figure], None] | None = None
    verdict: Callable[[Sequence[Record]], list[str]] = lambda records: []
    starts_ranks: bool = False


@dataclass(frozen=True)
class Outcome:
    """What a study came to.

    Attributes:
        records: One for each case, in order.
        cached: How many of them were computed by an earlier run.
        shortfalls: What they fall short of; the same on all ranks.
    """

    records: list[Record]
    cached: int
    shortfalls: list[str]


class Interrupted(Exception):
    """The user stopped a study; what was computed is kept."""


def run(
    study: Study, comm: MPI.Comm, out: Path, screen: Screen, *, quick: bool, fresh: bool
) -> Outcome:
    """Compute the cases of a study that no earlier run has, and write what comes of it. Collective.

    Args:
        study: What to run.
        comm: Communicator.
        out: Folder for ``NAME.csv``, ``NAME.json``, ``NAME.pdf``, ``NAME.png`` and the cases.
        screen: Where to report.
        quick: Whether to take the small grid.
        fresh: Whether to compute every case anew.

    Raises:
        OutputError: The folder cannot be written to.
        Interrupted: By Ctrl-C.
    """
    cases = list(study.grid(quick))
    cache = _Cache(study, comm, out / "cases")
    make_folder(comm, cache.folder)
    records: list[Record] = []
    cached = 0
    screen.line(f"study {study.name}: {len(cases)} cases")
    for k, parameters in enumerate(cases):
        record = None if fresh else cache.get(parameters)
        if record is None:
            screen.progress(study.name, k, len(cases), f"next: {_told(parameters)}")
            try:
                record = {**parameters, **study.compute(comm, parameters)}
            except KeyboardInterrupt:
                raise Interrupted(
                    f"interrupted: {k} of {len(cases)} cases are done and kept in {cache.folder}; "
                    "the same command goes on from there"
                ) from None
            cache.put(parameters, record)
        else:
            cached += 1
        records.append(record)
    screen.progress(study.name, len(cases), len(cases), f"{cached} from an earlier run")
    shortfalls: list[str] = []
    if comm.rank == 0:
        shortfalls = study.verdict(records)
        _write(study, records, out, screen, comm.size)
    return Outcome(records, cached, comm.bcast(shortfalls))


class _Cache:
    """Records on disk by what they depend on: parameters, ranks and the sources."""

    def __init__(self, study: Study, comm: MPI.Comm, folder: Path) -> None:
        self.folder = folder
        self._comm = comm
        digest = hashlib.sha256(f"{study.name} {comm.size}".encode())
        for source in (*_SOURCES, Path(__file__).parent):
            for file in sorted(source.rglob("*.py")):
                digest.update(file.read_bytes())
        self._digest = digest

    def _file(self, parameters: Parameters) -> Path:
        digest = self._digest.copy()
        digest.update(json.dumps(parameters, sort_keys=True).encode())
        return self.folder / f"{digest.hexdigest()[:16]}.json"

    def get(self, parameters: Parameters) -> Record | None:
        text = None
        if self._comm.rank == 0:
            try:
                text = self._file(parameters).read_text("utf-8")
            except OSError:
                text = None
        text = self._comm.bcast(text)
        return None if text is None else json.loads(text)

    def put(self, parameters: Parameters, record: Record) -> None:
        if self._comm.rank == 0:
            file = self._file(parameters)
            partial = file.with_suffix(".part")
            partial.write_text(json.dumps(record), "utf-8")
            os.replace(partial, file)  # whole or not at all


def _write(study: Study, records: Sequence[Record], out: Path, screen: Screen, ranks: int) -> None:
    stem = out / study.name
    document = {"study": study.name, "ranks": ranks, "records": records}
    stem.with_suffix(".json").write_text(json.dumps(document, indent=1), "utf-8")
    plain = [{k: v for k, v in r.items() if not isinstance(v, list | dict)} for r in records]
    columns = list(dict.fromkeys(key for record in plain for key in record))
    with stem.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(plain)
    if study.draw is not None:
        try:
            from matplotlib.figure import Figure  # optional
        except ModuleNotFoundError:
            screen.line("no figure: matplotlib is not installed (pip install matplotlib)")
            return
        figure = Figure(layout="constrained")
        study.draw(records, figure)
        for suffix in (".pdf", ".png"):
            figure.savefig(stem.with_suffix(suffix), dpi=200)


def _told(parameters: Parameters) -> str:
    return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in parameters.values())
