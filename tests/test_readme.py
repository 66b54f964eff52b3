"""The README's examples run as printed, and say what they give."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from demos.app import cli
from demos.app.arguments import parser
from demos.app.scene import built_in
from demos.studies import STUDIES

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
CALLS = re.findall(r"`mixed-fem ([^`]+)`|^ {4}mixed-fem (.+?)$", README, flags=re.MULTILINE)
COMMANDS = sorted({(a or b).replace("\n", " ") for a, b in CALLS})


def printed(command, folder):
    """What a command prints, run by itself, with forms compiled as a user has them."""
    env = {k: v for k, v in os.environ.items() if k != "XDG_CONFIG_HOME"}
    words = [sys.executable, "-m", "demos", *command.split()]
    done = subprocess.run(
        words, cwd=folder, env=env, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def table_after(first, text):
    """The lines of an indented block that begins with some words, without the indent."""
    block = re.search(rf"^ {{4}}({re.escape(first)}.*\n(?: {{4}}.*\n|\n(?= {{4}}))+)", text, re.M)
    return [line.strip() for line in block[1].splitlines()]


@pytest.mark.serial
def test_commands():
    """Each is one that the program takes: commands, options, scenes and studies by their names."""
    assert len(COMMANDS) > 20
    for command in COMMANDS:
        if "[" in command:  # a line of the summary
            assert command.split()[0] in cli.COMMANDS
            continue
        words = re.split(r" {2,}", command)[0].split()
        given = parser().parse_args([w for w in words if not w.startswith("-mixed_fem")])
        assert getattr(given, "name", "") == words[0]
        for word in set(words[1:2]) - {"SCENE", "NAME", "FILE", "RESULTS", "KEY=VALUES"}:
            place = {"run": built_in(), "sweep": built_in(), "study": STUDIES}.get(words[0], [word])
            assert word in place or word.endswith(".py"), command


@pytest.mark.serial
def test_the_table_of_make_demo(tmp_path):
    """The first step: who fails does, and the others take thrice as many iterations and more."""
    said = printed("run thrown-bear --steps 1", tmp_path)
    stated = table_after("Newton iterations of step", README)[1:]
    found = [line.strip() for line in said.splitlines()]
    found = found[1 + next(k for k, line in enumerate(found) if line.startswith("Newton iter")) :]
    (mixed,) = {int(rows[0].split()[1]) for rows in (stated, found)}
    for a, b in zip(stated[1:], found[1:], strict=False):
        assert a.split()[:2] == b.split()[:2]
        first = b.split()[2]
        assert first == "fails" if "fails" in a else int(first) > 3 * mixed


@pytest.mark.serial
def test_the_sweep(tmp_path):
    """The coarser meshes to the last digit."""
    (command,) = (c for c in COMMANDS if c.startswith("sweep stretched-bar"))
    said = printed(command.replace("0:3", "0:2"), tmp_path)
    for line in table_after("mesh.refine", README)[:4]:
        assert re.sub(" +", " ", line) in re.sub(" +", " ", said)


@pytest.mark.serial
def test_runs(tmp_path):
    """The bar that falls, with the sums of iterations as stated, and with PETSc's own monitor."""
    (command,) = (c for c in COMMANDS if "-mixed_fem_0_snes_monitor" in c)
    said = printed(command, tmp_path)
    mixed, other = re.search(r"prints (\d+) iterations beside (\d+)", README).groups()
    assert re.search(rf"^symmetric .* {mixed} +\d+\.\d+$", said, re.M)
    assert re.search(rf"^displacement .* {other} +\d+\.\d+ ", said, re.M)
    assert "SNES Function norm" in said


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
