"""Final positions computed by the method authors' own C++ code (../shared/reference)."""

from __future__ import annotations

import csv
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from demos.app.cli import main

REFERENCE = Path(__file__).parents[3] / "shared" / "reference"

SCENE = """
[mesh]
file = "{mesh}"

[[material]]
name = "stable-neo-hookean"
E = {E}
nu = 0.45
rho = 1000.0

[[boundary]]
where = {{ x = "max" }}
motion = "fixed"

[load]
gravity = [0.0, -9.8, 0.0]

[time]
h = 0.03333333333333333
steps = 10

[solve]
formulation = "{formulation}"
"""


@pytest.mark.skipif(not REFERENCE.is_dir(), reason="../shared/reference is not on this machine")
@pytest.mark.parametrize("formulation", ["symmetric", "seed"])
@pytest.mark.parametrize("E", ["1e6", "1e4"])
def test_reference(E, formulation, tmp_path):
    """1e-6 m in every coordinate, in at most five Newton iterations a step."""
    scene = tmp_path / "scene.toml"
    if MPI.COMM_WORLD.rank == 0:
        text = SCENE.format(mesh=REFERENCE / "box16.mesh", E=E, formulation=formulation)
        scene.write_text(text, encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    assert main(["run", str(scene), "--out", str(tmp_path / "out")]) == 0
    MPI.COMM_WORLD.barrier()
    with np.load(tmp_path / "out" / "final.npz") as final:
        x = final["x"]
    expected = np.loadtxt(REFERENCE / f"hangends_E{E}.txt")
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-6)
    with (tmp_path / "out" / "history.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    assert max(int(row["newton_iterations"]) for row in rows) <= 5
