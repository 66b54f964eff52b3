"""What was run, and by what: the contents of ``run.json``, and how two scenes differ."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import mpi4py
import petsc4py
from mpi4py import MPI

import dolfinx
import ffcx
import numpy as np
import ufl

from demos.app.files import PROGRAM
from demos.app.scene import Scene
from forms import HalfSpace

MODULES = (dolfinx, ufl, ffcx, petsc4py, mpi4py, np)

# A run may go on with other values of these.
FREE = ("description", "time.steps", "solve.baseline")


def about(scene: Scene, comm: MPI.Comm) -> dict[str, Any]:
    """What was run, and by what. Collective."""
    found: dict[str, Any] = {}
    if comm.rank == 0:
        found = {
            "program": PROGRAM,
            "name": scene.name,
            "scene": identity(scene),
            "file": scene.source,
            "text": scene.text,
            "gravity": list(scene.gravity),
            "planes": [
                [list(given.load.plane), float(given.load.offset)]
                for given in scene.loads
                if isinstance(given.load, HalfSpace) and isinstance(given.load.offset, int | float)
            ],
            "command": sys.argv[1:],
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": {
                "mixed-fem": metadata.version("mixed-fem"),
                "python": sys.version,
                **{module.__name__: module.__version__ for module in MODULES},
            },
            "git": _git(),
            "machine": {
                "platform": platform.platform(),
                "processor": platform.machine(),
                "cores": os.cpu_count(),
                "ranks": comm.size,
            },
        }
    return dict(comm.bcast(found))


def identity(scene: Scene) -> dict[str, Any]:
    """What the states of a run depend on: all keys of the scene, and the mesh file. On rank 0."""
    found = {key: value for key, value in scene.keys.items() if key not in FREE}
    if scene.mesh.file is not None:
        found["the mesh file"] = hashlib.sha256(scene.mesh.file.read_bytes()).hexdigest()[:16]
    return found


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """How a second scene differs from a first, a line a key."""
    return [
        f"{key} was {one.get(key, 'not there')} and is {other.get(key, 'not there')}"
        for key in {**one, **other}
        if one.get(key) != other.get(key)
    ]


def _git() -> str:
    """The commit of this checkout, and whether it has changed; empty where that is not known."""
    git, folder = shutil.which("git"), Path(__file__).parents[2]
    if git is None or not (folder / ".git").exists():
        return ""
    command = [git, "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20)
    return done.stdout.strip()
