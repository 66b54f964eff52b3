"""Studies and runs as a user has them."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

from mpi4py import MPI

import meshio
import pytest

from demos.app import viewer
from demos.app.cli import main
from demos.studies import Record
from tests.demos.strip import POINTS, STRIP, TRIANGLES


@pytest.fixture(scope="session")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., list[Record]]:
    """The records of `mixed-fem study NAME --quick`, run once; there are a table and a figure.

    By default the exit code must be 0: nothing falls short. For serial tests.
    """

    @cache
    def records(name: str, exit_code: int = 0) -> list[Record]:
        folder = tmp_path_factory.mktemp(name)
        assert main(["study", name, "--quick", "--out", str(folder)]) == exit_code
        found = {path.name for path in folder.iterdir() if path.is_file() and path.stat().st_size}
        assert {f"{name}.csv", f"{name}.json"} <= found
        if importlib.util.find_spec("matplotlib"):
            assert {f"{name}.pdf", f"{name}.png"} <= found
        document = json.loads((folder / f"{name}.json").read_text("utf-8"))
        return document["records"]

    return records


@pytest.fixture
def strip(tmp_path: Path) -> Path:
    """The scene file of the strip, next to its mesh."""
    path = tmp_path / "strip.toml"
    if MPI.COMM_WORLD.rank == 0:
        mesh = meshio.Mesh(POINTS, [("triangle", TRIANGLES)])
        mesh.write(tmp_path / "strip.mesh")
        path.write_text(STRIP)
    MPI.COMM_WORLD.barrier()
    return path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the seconds that a picture takes."""
    monkeypatch.setattr(viewer, "draw", lambda *_args, **_kwargs: "not needed by this test")
