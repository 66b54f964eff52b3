"""The README's examples run as printed, and say what they give."""

from __future__ import annotations

import re
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

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
    names: dict[str, object] = {}
    exec(EXAMPLES[1], names)
    example = EXAMPLES[0].replace("psi = StableNeoHookean(E=1e7, nu=0.45)", "pass")
    exec(example, names)
    assert max(names["iterations"]) <= 5
    assert np.isfinite(names["u"].x.array).all()


def test_ten_lines():
    """From the fields to the solution takes no more than ten lines."""
    body = EXAMPLES[0].split("u, S, Y = ")[1]
    assert len(body.strip().splitlines()) <= 10


def test_model():
    """A bar under its weight whose end has been turned by 0.1 rad, in 0.1 s."""
    names: dict[str, object] = {}
    (example,) = (e for e in EXAMPLES if "Twist(" in e)
    exec(example, names)
    assert names["scheme"].t == pytest.approx(0.1)
    u, body, right = names["model"].u, names["body"], names["right"]
    blocks = body.dofs(u.function_space, right)
    arm = u.function_space.tabulate_dof_coordinates()[blocks] - [4.0, 0.5, 0.5]
    turned = [
        [0.0, 0.0, 0.0],
        [0.0, np.cos(0.1) - 1, -np.sin(0.1)],
        [0.0, np.sin(0.1), np.cos(0.1) - 1],
    ]
    np.testing.assert_allclose(
        u.x.array.reshape(-1, 3)[blocks], arm @ np.transpose(turned), atol=1e-12
    )


def test_restart(tmp_path, monkeypatch):
    """What has been put back is the state after three steps."""
    monkeypatch.chdir(MPI.COMM_WORLD.bcast(str(tmp_path)))
    names: dict[str, object] = {}
    (example,) = (e for e in EXAMPLES if "checkpoint.save" in e)
    before = "saved = "
    first, second = example.split(before)
    exec(first, names)
    u = names["model"].u.x.array
    state = u.copy()
    u[:] = 0.0
    names["scheme"].t = 0.0
    exec(before + second, names)
    np.testing.assert_array_equal(u, state)
    assert names["scheme"].t == pytest.approx(0.3)
