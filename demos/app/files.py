"""Files of a run: whole or not at all, written on rank 0, and never over somebody else's."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from mpi4py import MPI

from solvers.files import write_whole

PROGRAM = "mixed-fem"
ABOUT = "run.json"


class OutputError(OSError):
    """Files cannot be written; the message is one line."""


def on_rank_0(comm: MPI.Comm, place: Path, action: Callable[[], None]) -> None:
    """Do something with files on rank 0. Collective.

    Raises:
        OutputError: On all ranks: it did not work.
    """
    error = None
    if comm.rank == 0:
        try:
            action()
        except OutputError as e:
            error = str(e)
        except OSError as e:
            error = cannot_write(place, e)
    error = comm.bcast(error)
    if error is not None:
        raise OutputError(error)


def cannot_write(place: Path, error: OSError) -> str:
    """What to say of a file that could not be written."""
    return f"{error.filename or place}: cannot be written ({error.strerror or error})"


def make_folder(comm: MPI.Comm, folder: Path) -> None:
    """Make a folder for results, before anything long is begun. Collective.

    Raises:
        OutputError: On all ranks: the folder cannot be made or written to.
    """

    def make() -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            why = "" if os.access(folder, os.W_OK | os.X_OK) else "Permission denied"
        except OSError as e:
            why = e.strerror or str(e)
        if why:
            raise OutputError(f"--out {folder}: cannot be written to ({why})")

    on_rank_0(comm, folder, make)


def claim(folder: Path, names: Iterable[str], header: Sequence[str]) -> None:
    """Insist that files which will be overwritten are of a former run. On rank 0.

    Args:
        folder: Where they are.
        names: Their names.
        header: How ``history.csv`` begins, by which a run of version 0.1 is known.

    Raises:
        OutputError: There is a file that this program has not written.
    """
    try:
        if json.loads((folder / ABOUT).read_text("utf-8"))["program"] == PROGRAM:
            return
    except (OSError, ValueError, KeyError, TypeError):
        pass
    try:
        with (folder / "history.csv").open(encoding="utf-8") as file:
            if file.readline().startswith(",".join(header)):
                return
    except (OSError, ValueError):
        pass
    refuse(folder, (ABOUT, *names), "run")


def refuse(folder: Path, names: Iterable[str], kind: str) -> None:
    """Refuse to overwrite files.

    Args:
        folder: Where they are.
        names: Their names.
        kind: What they are not of: a run, a study.

    Raises:
        OutputError: One of them is there.
    """
    for name in names:
        if (folder / name).exists():
            raise OutputError(
                f"--out {folder}: {name} there is not of a {kind} of {PROGRAM}, and would be "
                "overwritten; choose another folder"
            )


class Csv:
    """A table on disk, complete after every row."""

    def __init__(
        self, comm: MPI.Comm, path: Path, columns: Sequence[str], kept: int | None = None
    ) -> None:
        """Begin the table, or go on with one. Collective.

        Args:
            comm: Communicator.
            path: The file.
            columns: Its heading.
            kept: Rows are kept whose first column is at most this; None for a new table.
        """
        self._comm, self._path = comm, path

        def begin() -> None:
            rows = [] if kept is None else _rows(path, columns, kept)
            text = io.StringIO(newline="")
            csv.writer(text).writerows([columns, *rows])
            write_whole(path, lambda p: p.write_text(text.getvalue(), "utf-8", newline=""))

        on_rank_0(comm, path, begin)

    def row(self, values: Sequence[object]) -> None:
        """Write a row. Collective."""

        def write() -> None:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow(values)

        on_rank_0(self._comm, self._path, write)


def _rows(path: Path, columns: Sequence[str], kept: int) -> list[list[str]]:
    """The rows of a former run up to a step; a torn last one is not among them."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
    except (OSError, ValueError, csv.Error):
        return []
    if not rows or rows[0] != list(columns):
        return []
    return [
        row
        for row in rows[1:]
        if len(row) == len(columns) and row[0].isdigit() and int(row[0]) <= kept
    ]
