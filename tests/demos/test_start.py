"""How a scene starts: thrown, spinning, from the state in which another run has ended."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from demos.app.cli import main
from demos.app.output import final_state
from demos.app.scene import parse
from demos.app.simulation import Simulation, build_body
from demos.app.tables import SceneError
from tests.bodies import largest

COMM = MPI.COMM_WORLD

SCENE = """\
[mesh]
box = {{ size = {size}, cells = {cells} }}
[[material]]
name = "stable-neo-hookean"
E = 50.0
nu = 0.3
rho = 2.0
{boundary}
[start]
{start}
[time]
h = 0.05
steps = {steps}
scheme = "implicit-midpoint"
[solve]
formulation = "{formulation}"
degree = {degree}
"""
PLANE = {"size": [2.0, 1.0], "cells": [4, 2]}
SOLID = {"size": [2.0, 1.0, 0.5], "cells": [2, 1, 1]}
HELD = '[[boundary]]\nwhere = { x = "min" }\nmotion = "fixed"'


def made(folder=Path(), **changes):
    given = {"start": "", "boundary": "", "steps": 4, "formulation": "symmetric", "degree": 1}
    text = SCENE.format(**{**given, **PLANE, **changes})
    return parse(text, folder / "thrown.toml")


def simulation(scene):
    return Simulation(scene, build_body(scene, COMM))


@pytest.mark.parametrize(
    ("shape", "start", "kinetic"),
    [
        # ½ m v² + ½ J ω² with m = 4 kg, J = m (2² + 1²)/12
        (PLANE, "velocity = [1.0, 2.0]\nspin = 3.0", 2 * 5.0 + 4.0 * 5.0 / 24 * 9.0),
        (SOLID, "velocity = [0, 0, 2.0]", 2.0 / 2 * 4.0),
        # about y and z through the middle: J = m (2² + 0.5²)/12 and m (2² + 1²)/12, m = 2 kg
        (SOLID, "spin = [0.0, 1.0, 2.0]", 2.0 / 24 * (4.25 * 1.0 + 5.0 * 4.0)),
        # about a corner: + m |c|², |c|² = 1 + 0.25
        (PLANE, "spin = 1.0\ncentre = [0.0, 0.0]", 4.0 / 2 * (5.0 / 12 + 1.25)),
    ],
)
def test_energy_of_what_is_thrown(shape, start, kinetic):
    scene = made(start=start, **shape)
    assert simulation(scene).energies().kinetic == pytest.approx(kinetic, rel=1e-12)


def test_a_thrown_body_flies_straight():
    """Its middle by v t, while it turns and is strained by it."""
    run = simulation(made(start="velocity = [1.0, 2.0]\nspin = 3.0", steps=8))
    for _ in run.march(8):
        pass
    state = final_state(run)
    if state is not None:
        middle = (state["x"] - state["X"])[[0, -1]].mean(axis=0)  # of two opposite corners
        np.testing.assert_allclose(middle, [0.4, 0.8], atol=1e-9)
        assert np.abs(state["S"] - np.eye(2)).max() > 0.02


def test_what_is_held_is_not_thrown():
    run = simulation(made(start="velocity = [0.0, 1.0]", boundary=HELD))
    X = run.model.u.function_space.tabulate_dof_coordinates()
    v = run.scheme.v.x.array.reshape(-1, 2)
    assert largest(v[X[:, 0] < 1e-9]) == 0.0
    assert largest(v[X[:, 0] > 1e-9] - [0.0, 1.0]) == 0.0


@pytest.mark.parametrize(
    ("formulation", "shape"),
    [
        ("symmetric", PLANE),
        ("displacement", PLANE),
        ("rotation-field", PLANE),
        ("symmetric", SOLID),
    ],
)
def test_a_start_from_a_former_result(tmp_path, formulation, shape):
    """Half of the steps and then the other half: as all of them at once."""
    velocity = [0.0, 1.0, 0.0][: len(shape["size"])]
    thrown = {"start": f"velocity = {velocity}", "boundary": HELD, "formulation": formulation}
    whole = simulation(made(**shape, **thrown))
    for _ in whole.march(4):
        pass
    half = simulation(made(**shape, **thrown))
    for _ in half.march(2):
        pass
    energies, state = half.energies(), final_state(half)
    if state is not None:
        np.savez(tmp_path / "half.npz", **state)
    folder = Path(COMM.bcast(str(tmp_path)))
    COMM.barrier()
    other = {**shape, **thrown, "start": 'result = "half.npz"'}
    rest = simulation(made(folder, **other))
    np.testing.assert_allclose(rest.energies(), energies, rtol=1e-9, atol=1e-12)
    for _ in rest.march(2):
        pass
    assert largest(whole.model.u.x.array) > 0.1
    assert largest(whole.model.u.x.array - rest.model.u.x.array) < 1e-8
    assert largest(whole.scheme.v.x.array - rest.scheme.v.x.array) < 1e-7


def test_no_load_and_no_motion_on_the_command_line(tmp_path):
    """A scene of nothing but a body that spins runs, and is drawn."""
    if COMM.rank == 0:
        text = SCENE.format(
            start="spin = 2.0", boundary="", steps=1, formulation="symmetric", degree=1, **PLANE
        )
        (tmp_path / "spin.toml").write_text(text)
    COMM.barrier()
    folder = Path(COMM.bcast(str(tmp_path)))
    assert main(["run", str(folder / "spin.toml"), "--out", str(folder / "out")]) == 0


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ("velocity = [1.0, 2.0, 3.0]", "[start]: velocity has 3 components; the body lives in 2D"),
        ("spin = [1.0, 2.0, 3.0]", "[start]: spin has 3 components; in 2D it must be a number"),
        ('spin = "fast"', '[start] spin = "fast": must be a finite number or a list of finite'),
        ("spinn = 1.0", "[start]: unknown key spinn (did you mean spin?)"),
        ('result = "none.npz"', 'none.npz": cannot be read (No such file or directory)'),
        ('result = "thrown.toml"', 'thrown.toml": is no final.npz of a run'),
    ],
)
def test_what_is_refused(tmp_path, start, message):
    if COMM.rank == 0:
        (tmp_path / "thrown.toml").write_text("a = 1")
    folder = Path(COMM.bcast(str(tmp_path)))
    COMM.barrier()
    with pytest.raises(SceneError) as error:
        simulation(made(folder, start=start))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
