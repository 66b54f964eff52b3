"""How a study runs: cases from a cache or computed, then a table and a figure."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

from demos.app.files import make_folder, on_rank_0, refuse
from demos.app.progress import Screen, duration
from demos.studies.records import Record, of_case, plain
from demos.studies.sources import sources
from demos.studies.study import Parameters, Study
from solvers.files import write_whole

_SUFFIXES = (".json", ".csv", ".pdf", ".png")


@dataclass(frozen=True)
class Outcome:
    """What a study came to.

    Attributes:
        records: Those of each case, in order.
        cached: How many cases were computed by an earlier run.
        shortfalls: What they fall short of; the same on all ranks.
    """

    records: list[Record]
    cached: int
    shortfalls: list[str]


class Interrupted(Exception):
    """The user stopped a study; what was computed is kept."""


def run(
    study: Study,
    comm: MPI.Comm,
    out: Path,
    screen: Screen,
    *,
    quick: bool,
    fresh: bool,
    kept: bool = True,
) -> Outcome:
    """Compute the cases of a study that no earlier run has, and write what comes of it. Collective.

    Args:
        study: What to run.
        comm: Communicator.
        out: Folder for ``NAME.csv``, ``NAME.json``, ``NAME.pdf``, ``NAME.png`` and the cases.
        screen: Where to report.
        quick: Whether to take the small grid.
        fresh: Whether to compute every case anew.
        kept: Whether later runs may take the cases from this one; not if they depend on anything
            but their parameters, the number of ranks and the sources.

    Raises:
        OutputError: The folder cannot be written to, or has other people's files.
        Interrupted: By Ctrl-C.
    """
    cases = list(study.grid(quick))
    cache = _Cache(study, comm, out / "cases")
    make_folder(comm, cache.folder)
    on_rank_0(comm, out, lambda: _claim(study, out))
    where = f" and kept in {cache.folder}; the same command goes on from there" if kept else ""
    records: list[Record] = []
    cached = 0
    screen.line(f"study {study.name}: {len(cases)} cases")
    start = time.monotonic()
    for k, parameters in enumerate(cases):
        found = None if fresh or not kept else cache.get(parameters)
        if found is None:
            left = (time.monotonic() - start) / (k - cached) * (len(cases) - k) if k > cached else 0
            told = f"next: {_told(parameters)}" + (f"; {duration(left)} left" if left else "")
            screen.progress(study.name, k, len(cases), told)
            try:
                found = of_case(parameters, study.compute(comm, parameters))
            except KeyboardInterrupt:
                done = f"interrupted: {k} of {len(cases)} cases are done"
                raise Interrupted(f"{done}{where}") from None
            if kept:
                cache.put(parameters, found)
        else:
            cached += 1
        records += found
    screen.progress(study.name, len(cases), len(cases), f"{cached} from an earlier run")
    shortfalls: list[str] = []
    if comm.rank == 0:
        shortfalls = study.verdict(records)
    on_rank_0(comm, out, lambda: _write(study, records, out, screen, comm.size))
    return Outcome(records, cached, comm.bcast(shortfalls))


class _Cache:
    """Records of cases on disk by what these depend on: parameters, ranks and their sources."""

    def __init__(self, study: Study, comm: MPI.Comm, folder: Path) -> None:
        self.folder = folder
        self._comm = comm
        digest = hashlib.sha256(f"{study.name} {study.depends} {comm.size}".encode())
        for text in sources(study.compute).values():
            digest.update(text.encode())
        self._digest = digest

    def _file(self, parameters: Parameters) -> Path:
        digest = self._digest.copy()
        digest.update(json.dumps(parameters, sort_keys=True).encode())
        return self.folder / f"{digest.hexdigest()[:16]}.json"

    def get(self, parameters: Parameters) -> list[Record] | None:
        found = None
        if self._comm.rank == 0:
            try:
                found = json.loads(self._file(parameters).read_text("utf-8"))
            except (OSError, ValueError):  # there is none, or none that can be read
                found = None
        return self._comm.bcast(found)

    def put(self, parameters: Parameters, found: list[Record]) -> None:
        file, text = self._file(parameters), json.dumps(found)

        def write() -> None:
            write_whole(file, lambda path: path.write_text(text, "utf-8"))

        on_rank_0(self._comm, file, write)


def _claim(study: Study, out: Path) -> None:
    """Insist that files which will be overwritten are of the study.

    Raises:
        OutputError: There is a file that this program has not written.
    """
    try:
        document = json.loads((out / f"{study.name}.json").read_text("utf-8"))
        if document["study"] == study.name:
            return
    except (OSError, ValueError, KeyError, TypeError):
        pass
    refuse(out, [f"{study.name}{suffix}" for suffix in _SUFFIXES], "study")


def _write(study: Study, records: Sequence[Record], out: Path, screen: Screen, ranks: int) -> None:
    def write(suffix: str, fill: Callable[[Path], object]) -> None:
        write_whole(out / f"{study.name}{suffix}", fill)

    document = json.dumps({"study": study.name, "ranks": ranks, "records": records}, indent=1)
    write(".json", lambda path: path.write_text(document, "utf-8"))
    rows = plain(records)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, columns)
    writer.writeheader()
    writer.writerows(rows)
    write(".csv", lambda path: path.write_text(table.getvalue(), "utf-8", newline=""))
    if study.draw is not None:
        try:
            from matplotlib.figure import Figure  # optional
        except ModuleNotFoundError:
            screen.line("no figure: matplotlib is not installed (pip install matplotlib)")
            return
        figure = Figure(layout="constrained")
        study.draw(records, figure)
        write(".pdf", lambda path: figure.savefig(path))
        write(".png", lambda path: figure.savefig(path, dpi=200))


def _told(parameters: Parameters) -> str:
    return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in parameters.values())
