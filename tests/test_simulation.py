"""Scenes with compiled kernels and with UFL alone give the same motion."""

from __future__ import annotations

import logging
import sys

from mpi4py import MPI

import numpy as np
import pytest

from demos.scene import load
from demos.simulation import Simulation, build_body

SCENE = """
[mesh]
box = {{ size = [2.0, 1.0], cells = [4, 2] }}

[[material]]
name = "stable-neo-hookean"
E = 1e5
nu = 0.4
rho = 1000.0

[[boundary]]
where = {{ x = "min" }}
motion = "fixed"

[load]
gravity = [0.0, -9.8]

[time]
h = 0.1
steps = 2

[solve]
formulation = "{formulation}"
kernels = "{kernels}"
"""


def simulate(folder, formulation, kernels):
    """What evaluated the Newton system, and the displacement after two steps."""
    path = folder / f"{formulation}-{kernels}.toml"
    if MPI.COMM_WORLD.rank == 0:
        path.write_text(SCENE.format(formulation=formulation, kernels=kernels), encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    scene = load(MPI.COMM_WORLD, str(path))
    simulation = Simulation(scene, build_body(scene, MPI.COMM_WORLD), scene.formulation)
    for _ in simulation.march(scene.steps):
        pass
    return simulation.kernels, simulation.fields[0].x.array.copy()


@pytest.mark.parametrize(
    ("formulation", "used"),
    [("symmetric", "compiled"), ("seed", "ufl"), ("displacement", "compiled")],
)
def test_kernels_are_a_switch(tmp_path, formulation, used):
    pytest.importorskip("numba")
    compiled, u = simulate(tmp_path, formulation, "compiled")
    ufl, u_ufl = simulate(tmp_path, formulation, "ufl")
    assert (compiled, ufl) == (used, "ufl")
    np.testing.assert_allclose(u, u_ufl, rtol=0, atol=1e-10)
    assert MPI.COMM_WORLD.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX) > 0.05


def test_without_numba_the_slow_way_says_so(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [n for n in sys.modules if n.startswith("forms.kernels.")]:
        monkeypatch.delitem(sys.modules, name)
    with caplog.at_level(logging.WARNING, logger="mixed_fem"):
        used, _ = simulate(tmp_path, "symmetric", "compiled")
    assert used == "ufl"
    assert "numba is not installed" in caplog.text


def test_field_splits_are_a_switch(tmp_path):
    """`solver = "fieldsplit"` in a scene: the same motion, by UFL, as field splits need blocks."""
    _, condensed = simulate(tmp_path, "symmetric", "ufl")
    kernels, split = simulate(tmp_path, "symmetric", 'compiled"\nsolver = "fieldsplit')
    assert kernels == "ufl"
    np.testing.assert_allclose(split, condensed, rtol=0, atol=1e-9 * np.abs(condensed).max())
