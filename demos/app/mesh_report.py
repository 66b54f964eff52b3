"""`mixed-fem mesh`: look into a mesh file, print what it holds and what is wrong with it."""

from __future__ import annotations

import json
from pathlib import Path

from mpi4py import MPI

from demos.app.progress import Screen
from demos.app.tables import SceneError
from meshes import MeshError
from meshes.report import Report, report


def run(comm: MPI.Comm, path: Path, scale: float, as_json: bool) -> int:
    """Read and print on rank 0. Collective.

    Returns:
        The exit code: 0, or 2 where the mesh cannot be used.

    Raises:
        SceneError: On all ranks: the file is no mesh of one kind of straight cells.
    """
    found: Report | None = None
    error: str | None = None
    if comm.rank == 0:
        try:
            found = report(path, scale)
        except MeshError as e:
            error = str(e)
    error = comm.bcast(error)
    if error is not None:
        raise SceneError(error)
    if found is not None:
        screen = Screen(comm)
        for line in [json.dumps(found.data(), indent=2)] if as_json else found.lines():
            screen.line(line)
    return int(comm.bcast(None if found is None else (0 if found.usable else 2)))
