"""The README's examples run as printed, and say what they give."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import ufl

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_example():
    """The ten lines run, in the Newton iterations that the README states."""
    names: dict[str, object] = {}
    exec(EXAMPLES[0], names)
    stated = re.search(r"`iterations` is `\[(.*?)\]`", README)
    assert names["iterations"] == [int(n) for n in stated[1].split(",")]


def test_another_strain_energy():
    """The README's own Ψ(S) takes the place of the material without another change."""
    names: dict[str, object] = {"Identity": ufl.Identity, "inner": ufl.inner, "tr": ufl.tr}
    exec(EXAMPLES[1], names)
    example = EXAMPLES[0].replace("psi = StableNeoHookean(E=1e7, nu=0.45)", "pass")
    exec(example, names)
    assert max(names["iterations"]) <= 5
    assert np.isfinite(names["u"].x.array).all()


def test_kernel():
    """The README's call with a compiled kernel, in the same Newton iterations."""
    pytest.importorskip("numba")
    names: dict[str, object] = {}
    line = "problem = MixedProblem(energy, (u, S, Y), bcs=[clamped])\n"
    imported = "from forms.kernels import SymmetricKernel\n"
    assert line in EXAMPLES[0]
    exec(imported + EXAMPLES[0].replace(line, EXAMPLES[2]), names)
    assert names["iterations"] == [3, 3, 3]


def test_ten_lines():
    """From the fields to the solution takes no more than ten lines."""
    body = EXAMPLES[0].split("u, S, Y = ")[1]
    assert len(body.strip().splitlines()) <= 10
