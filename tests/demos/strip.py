"""A strip of triangles that hangs from its end, its mesh in a file, and its tables."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from demos.app.scene import Scene, parse

# A strip, its vertices and cells listed in no order that DOLFINx would choose.
POINTS = np.array([[2.0, 0], [0, 0], [1, 1], [0, 1], [1, 0], [2, 1], [3, 1], [3, 0]])
TRIANGLES = np.array([[2, 0, 5], [4, 1, 2], [6, 0, 7], [1, 3, 2], [2, 4, 0], [0, 6, 5]])

STRIP = """\
[mesh]
file = "strip.mesh"
[[material]]
name = "stable-neo-hookean"
E = 1e5
nu = 0.4
rho = 1000.0
[[boundary]]
where = { x = "min" }
motion = "fixed"
[load]
gravity = [0.0, -9.81]
[time]
h = 0.05
steps = 3
[solve]
baseline = "displacement"
"""


def scene(path: Path) -> Scene:
    return parse(path.read_text(), path)


def table(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [key for key in rows[0] if key != "note"]
    return {key: np.array([float(row[key]) for row in rows]) for key in numbers}
