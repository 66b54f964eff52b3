"""What a simulation computes, against other means and by other solvers."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem

from demos.app.scene import parse
from demos.app.simulation import Simulation, build_body
from demos.app.tables import SceneError
from forms import Corotational, deformation_gradient
from tests.bodies import largest

COMM = MPI.COMM_WORLD

SCENE = """
[mesh]
box = {{ size = {size}, cells = {cells} }}

[[material]]
name = "{material}"
E = 1e5
nu = 0.4
rho = 1000.0

[[boundary]]
where = {{ x = "min" }}
motion = "fixed"

[load]
gravity = {gravity}

[time]
h = 0.1
steps = 2

[solve]
formulation = "{formulation}"
solver = "{solver}"
"""
PLANE = {"size": [2.0, 1.0], "cells": [4, 2], "gravity": [0.0, -9.8]}
SOLID = {"size": [2.0, 1.0, 1.0], "cells": [2, 1, 1], "gravity": [0.0, -9.8, 0.0]}


def simulate(
    shape, material="stable-neo-hookean", formulation="symmetric", solver="condensed"
) -> Simulation:
    """A scene after two steps."""
    text = SCENE.format(material=material, formulation=formulation, solver=solver, **shape)
    scene = parse(text, Path("bar.toml"))
    simulation = Simulation(scene, build_body(scene, COMM))
    for _ in simulation.march(scene.steps):
        pass
    return simulation


def test_stress_is_that_of_the_present_rotation():
    """In 3D R is per-cell data, which no form of a compiled problem refreshes."""
    simulation = simulate(SOLID, material="corotational")
    u = simulation.fields[0]
    cells = np.arange(len(simulation.body.file_cells), dtype=np.int32)
    gradient = fem.Expression(deformation_gradient(u), np.full((1, 3), 0.25))
    F = gradient.eval(simulation.body.mesh, cells)[:, 0]
    U, sigma, Vt = np.linalg.svd(F)
    psi = Corotational(1e5, 0.4)
    strain = sigma - 1.0
    principal = 2 * psi.mu * strain + psi.lam * strain.sum(axis=1, keepdims=True)
    P = np.einsum("nik,nk,nkj->nij", U, principal, Vt)
    np.testing.assert_allclose(simulation.cell_means().stress, P, rtol=0, atol=1e-8 * psi.E)
    assert largest(U @ Vt - np.eye(3)) > 0.03


@pytest.mark.parametrize("solver", ["fieldsplit", "direct"])
def test_solvers_are_a_switch(solver):
    """The same motion by each."""
    condensed, other = (
        simulate(PLANE, solver=name).model.u.x.array for name in ("condensed", solver)
    )
    assert largest(condensed) > 0.05
    assert largest(other - condensed) < 1e-9 * largest(condensed)


def test_globalisations_are_a_switch():
    """The displacement's own descents arrive where the mixed method does, and are not for it."""
    key = '{0}"\nglobalisation = "project-on-demand'
    mixed, alone = (
        simulate(PLANE, formulation=name).model.u.x.array
        for name in ("symmetric", key.format("displacement"))
    )
    assert largest(alone - mixed) < 1e-7 * largest(mixed)
    message = "globalisation 'project-on-demand' needs the displacement alone"
    with pytest.raises(SceneError, match=message):
        simulate(PLANE, formulation=key.format("symmetric"))


def test_a_formulation_that_does_not_go_with_a_solver():
    """One line names the setting and the reason."""
    message = r'bar.toml: \[solve\] solver = "fieldsplit": the field p is not local to cells'
    with pytest.raises(SceneError, match=message):
        simulate(PLANE, formulation="taylor-hood", solver="fieldsplit")
