"""Every narrative demo runs to its end, in serial and in parallel; its assertions are the test."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

import demos

FOLDER = Path(demos.__file__).parent
NARRATIVES = sorted(p.name for p in FOLDER.glob("*.py") if "\n# %%" in p.read_text("utf-8"))


def test_there_are_narratives():
    assert "hand_derived.py" in NARRATIVES


@pytest.mark.parametrize("name", NARRATIVES)
def test_demo_runs(name):
    runpy.run_path(str(FOLDER / name), run_name="__main__")
