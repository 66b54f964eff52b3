"""Scenes with compiled kernels and with UFL alone give the same motion."""

from __future__ import annotations

import logging
import sys

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem

from demos.scene import load
from demos.simulation import Simulation, build_body
from demos.tables import SceneError
from forms import Corotational, deformation_gradient

SCENE = """
[mesh]
box = {{ size = [2.0, 1.0], cells = [4, 2]{cell} }}

[[material]]
name = "{material}"
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
solver = "{solver}"
degree = {degree}
"""


def simulate(
    folder,
    formulation,
    kernels,
    material="stable-neo-hookean",
    solver="condensed",
    cell="triangle",
    degree=1,
):
    """What evaluated the Newton system, and the displacement after two steps."""
    path = folder / f"{formulation}-{kernels}.toml"
    if MPI.COMM_WORLD.rank == 0:
        text = SCENE.format(
            formulation=formulation,
            kernels=kernels,
            material=material,
            solver=solver,
            cell=f', cell = "{cell}"',
            degree=degree,
        )
        path.write_text(text, encoding="utf-8")
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
    chosen, u = simulate(tmp_path, formulation, "auto")
    ufl, u_ufl = simulate(tmp_path, formulation, "ufl")
    assert (chosen, ufl) == (used, "ufl")
    np.testing.assert_allclose(u, u_ufl, rtol=0, atol=1e-10)
    assert MPI.COMM_WORLD.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX) > 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"formulation": "seed"}, 'none for the formulation "seed"; there are for symmetric, dis'),
        ({"material": "hencky"}, "none for hencky; there are for one strain energy out of as-ri"),
        ({"solver": "direct"}, 'none go with the solver "direct"; take "condensed"'),
        ({"degree": 2}, "none but for displacements of degree 1 on triangles or tetrahedra"),
        ({"cell": "quadrilateral"}, "none but for displacements of degree 1 on triangles or tet"),
    ],
)
def test_kernels_that_there_are_not(tmp_path, change, message):
    """Insisted on they are refused in one line; left to choose, a scene takes UFL."""
    wanted = {"formulation": "symmetric"} | change
    with pytest.raises(SceneError, match=r'\[solve\] kernels = "compiled": .*' + message) as caught:
        simulate(tmp_path, kernels="compiled", **wanted)
    assert "\n" not in str(caught.value)
    assert simulate(tmp_path, kernels="auto", **wanted)[0] == "ufl"


def test_without_numba_the_slow_way_says_so(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [n for n in sys.modules if n.startswith("forms.kernels.")]:
        monkeypatch.delitem(sys.modules, name)
    with caplog.at_level(logging.WARNING, logger="mixed_fem"):
        used, _ = simulate(tmp_path, "symmetric", "auto")
    assert used == "ufl"
    assert "numba is not installed" in caplog.text
    with pytest.raises(SceneError, match="numba is not installed"):
        simulate(tmp_path, "symmetric", "compiled")


def test_stress_with_kernels_is_that_of_the_present_rotation(tmp_path):
    """In 3D R is per-cell data, which no form of a compiled problem refreshes."""
    pytest.importorskip("numba")
    path = tmp_path / "bar.toml"
    text = SCENE.format(
        formulation="symmetric",
        kernels="compiled",
        material="corotational",
        solver="condensed",
        cell="",
        degree=1,
    )
    text = text.replace("[2.0, 1.0]", "[2.0, 1.0, 1.0]").replace("[4, 2]", "[2, 1, 1]")
    text = text.replace("-9.8]", "-9.8, 0.0]")
    if MPI.COMM_WORLD.rank == 0:
        path.write_text(text, encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    scene = load(MPI.COMM_WORLD, str(path))
    simulation = Simulation(scene, build_body(scene, MPI.COMM_WORLD), scene.formulation)
    list(simulation.march(scene.steps))
    u = simulation.fields[0]
    cells = np.arange(len(simulation.body.file_cells), dtype=np.int32)
    gradient = fem.Expression(deformation_gradient(u), np.full((1, 3), 0.25))
    F = gradient.eval(simulation.body.mesh, cells)[:, 0]
    U, sigma, Vt = np.linalg.svd(F)
    psi = Corotational(1e5, 0.4)
    strain = sigma - 1.0
    principal = 2 * psi.mu * strain + psi.lam * strain.sum(axis=1, keepdims=True)
    P = np.einsum("nik,nk,nkj->nij", U, principal, Vt)
    np.testing.assert_allclose(simulation.stress(), P, rtol=0, atol=1e-8 * psi.E)
    largest = MPI.COMM_WORLD.allreduce(np.abs(U @ Vt - np.eye(3)).max(initial=0.0), op=MPI.MAX)
    assert largest > 0.03


def test_field_splits_are_a_switch(tmp_path):
    """`solver = "fieldsplit"` in a scene: the same motion, by UFL, as field splits need blocks."""
    _, condensed = simulate(tmp_path, "symmetric", "ufl")
    kernels, split = simulate(tmp_path, "symmetric", "auto", solver="fieldsplit")
    assert kernels == "ufl"
    np.testing.assert_allclose(split, condensed, rtol=0, atol=1e-9 * np.abs(condensed).max())
