"""Studies from files of the user."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Collection
from pathlib import Path
from types import ModuleType

from mpi4py import MPI

from demos.studies.study import Study


class StudyError(ValueError):
    """A file has no studies to run; the message is one line."""


def studies_in(comm: MPI.Comm, path: Path, known: Collection[Study]) -> list[Study]:
    """Import a Python file and find its studies. Collective.

    Args:
        comm: Communicator; all of its ranks import the file.
        path: The file. What it imports must be installed or on PYTHONPATH.
        known: Studies that the file may import, and that do not count as its own.

    Returns:
        Every other `Study` at the top level of the file, whatever its name there.

    Raises:
        StudyError: On all ranks: the file cannot be read, raises, or has no studies.
    """
    studies: list[Study] = []
    error = None
    try:
        studies = _studies(path, known)
    except StudyError as e:
        error = str(e)
    if errors := [e for e in comm.allgather(error) if e is not None]:
        raise StudyError(errors[0])
    return studies


def _studies(path: Path, known: Collection[Study]) -> list[Study]:
    values = vars(_imported(path)).values()
    found = {id(v): v for v in values if isinstance(v, Study) and not any(v is k for k in known)}
    names = [study.name for study in found.values()]
    if not found:
        raise StudyError(f"{path}: has no study; write one at its top level, MINE = Study(...)")
    if twice := {name for name in names if names.count(name) > 1}:
        raise StudyError(f"{path}: has several studies called {twice.pop()}; each needs a name")
    return list(found.values())


def _imported(path: Path) -> ModuleType:
    try:
        text = path.read_text("utf-8")
    except OSError as e:
        raise StudyError(f"{path}: cannot be read ({e.strerror})") from e
    except UnicodeDecodeError as e:
        raise StudyError(f"{path}: not a text file; a study is written in Python") from e
    except ValueError as e:
        raise StudyError(f"{str(path)!r}: no name of a file ({e})") from e
    # The path is its name among the modules too, where no other has it.
    module = sys.modules[str(path)] = ModuleType(str(path))
    module.__file__ = str(path)
    try:
        exec(compile(text, path, "exec"), vars(module))
    except (Exception, SystemExit) as e:
        lines = [f.lineno for f in traceback.extract_tb(e.__traceback__) if f.filename == str(path)]
        where = f", line {lines[-1]}" if lines else ""
        raise StudyError(f"{path}{where}: {type(e).__name__}: {e}") from e
    return module
