"""Damaged mesh files: read, or refused with one line, whatever has happened to them."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshes import MeshError
from meshes.readers import load
from meshes.report import report
from tests.mesh_files import TETRAHEDRA
from tests.meshes import test_mesh_abaqus, test_mesh_vtk, test_mesh_writers
from tests.meshes.test_mesh_formats import GMSH41

pytestmark = pytest.mark.serial

ELEMENTS = [(2, [3, 1], [1, 2, 3]), *((4, [k, 1], c.tolist()) for k, c in enumerate(TETRAHEDRA, 4))]
SAMPLES = {
    "a.mesh": (test_mesh_writers.MMG, test_mesh_writers.BAMG),
    "a.msh": (
        test_mesh_writers.gmsh_22(ELEMENTS, test_mesh_writers.NAMES),
        test_mesh_writers.gmsh_41({(2, 1): [3, -8], (3, 1): [4, 5]}),
        GMSH41,
    ),
    "a.inp": (test_mesh_abaqus.FLAT, test_mesh_abaqus.PARTS + test_mesh_abaqus.ASSEMBLY),
    "a.vtk": (*test_mesh_vtk.FILES.values(), test_mesh_vtk.IMAGE + test_mesh_vtk.GRIDS["points"]),
    "a.ele": ("2 4 1\n1 1 3 2 5 4\n2 4 1 2 3 9\n# end\n", "1 4 0\n0 0 1 2 3\n"),
}
# What may take the place of a word.
WORDS = st.one_of(
    st.integers(-3, 12).map(str),
    st.sampled_from(["nan", "-inf", "1e300", "0.5", "4294967303", "99999999999999999999", "-1"]),
    st.sampled_from(
        ["", "$EndNodes", "*NODE", "Triangles", "CELL_TYPES", "End", "#", '"', "é\x00"]
    ),
)
EDITS = st.lists(
    st.tuples(st.sampled_from(["replace", "drop", "twice", "cut"]), st.floats(0, 1), WORDS),
    min_size=1,
    max_size=4,
)


def damaged(text: str, edits) -> str:
    """Words replaced, left out or doubled, and the rest cut off."""
    for what, where, word in edits:
        words = text.split(" ")
        if what == "cut":
            text = text[: int(where * len(text))]
            continue
        lines = text.split("\n")
        k = int(where * (len(lines) - 1))
        words = lines[k].split(" ")
        j = int(where * 997) % len(words)
        words[j : j + 1] = {"replace": [word], "drop": [], "twice": words[j : j + 1] * 2}[what]
        lines[k] = " ".join(words)
        text = "\n".join(lines)
    return text


@pytest.mark.parametrize("name", SAMPLES)
def test_damaged_files(name, tmp_path, caplog):
    """No traceback, no second line, no cell with a vertex that is not there."""
    path = tmp_path / name
    caplog.set_level(logging.CRITICAL)
    if name == "a.ele":
        path.with_suffix(".node").write_text("5 3 0 1\n" + test_mesh_writers.rows(NUMBERED, 1))

    @settings(suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(SAMPLES[name]), EDITS)
    def read_or_refuse(text, edits):
        path.write_text(damaged(text, edits), encoding="latin-1", errors="replace")
        try:
            raw = load(path, checked=True)
        except MeshError as error:
            assert "\n" not in str(error) and str(error).startswith(f"{path}: ")
        else:
            assert np.isfinite(raw.points).all() and raw.cells.max() < len(raw.points)
        try:
            report(path).lines()
        except MeshError as error:
            assert "\n" not in str(error)

    read_or_refuse()


NUMBERED = np.c_[test_mesh_writers.TIP, [0, 3, 3, 3, 3]]
