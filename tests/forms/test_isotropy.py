"""`lagged-rotation` takes isotropic strain energies only, and tells them apart from others."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    MATERIALS,
    Hencky,
    MooneyRivlin,
    StableNeoHookean,
    by_tag,
    mixed_fields,
    point_field,
)
from forms.materials import require_isotropic
from tests.bodies import SOME
from tests.states import small_mesh

COMM = MPI.COMM_WORLD
E, NU = 1e6, 0.4
PSI = StableNeoHookean(E, NU)


def fibres(msh):
    """A direction of its own in each cell."""
    d = msh.geometry.dim
    a = fem.Function(fem.functionspace(msh, ("DG", 0, (d,))), name="a")
    a.interpolate(lambda X: np.array([np.cos(1.3 * X[0]), np.sin(1.3 * X[0]), 0 * X[0]])[:d])
    return lambda S: PSI(S) + 5 * E / 4 * (ufl.inner(S * a, S * a) - 1) ** 2


def active(msh):
    """Fibres with an activation that is zero at present."""
    k = fem.Constant(msh, 0.0)
    return lambda S: PSI(S) + k * S[0, 0]


def viscous(msh):
    """A former stretch, at present the identity."""
    d = msh.geometry.dim
    S_old = point_field(msh, np.eye(d), symmetric=True)
    return lambda S: PSI(S) + E * ufl.inner(S - S_old, S - S_old)


def layered(msh):
    """Stiffer along a direction that depends on the place."""
    X = ufl.SpatialCoordinate(msh)
    return lambda S: PSI(S) + 1e-3 * E * ufl.cos(X[0]) * S[0, 1]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("psi", [fibres, active, viscous, layered])
def test_directions_are_refused(psi, d):
    msh = small_mesh(d)
    fields = mixed_fields(msh)
    with pytest.raises(ValueError, match="lagged-rotation holds for isotropic strain energies onl"):
        FORMULATIONS["lagged-rotation"].density(*fields, psi(msh))
    # Others take it.
    FORMULATIONS["symmetric"].density(*fields, psi(msh))


@pytest.mark.parametrize(("d", "degree"), [(2, 1), (3, 2)])
def test_isotropic_ones_pass(d, degree):
    """Every material, in 3D some; several of them by cell; damage; with points and without."""
    msh = small_mesh(d)
    _, S, _ = mixed_fields(msh, degree=degree)
    cells = msh.topology.index_map(d)
    every = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    tags = mesh.meshtags(msh, d, every, every % 2)
    energies = [MATERIALS[name](E, NU) for name in (MATERIALS if d == 2 else SOME)]
    energies.append(by_tag(msh, tags, {0: Hencky(E, NU), 1: MooneyRivlin(1e3 * E, NU)}))
    damage = point_field(msh, 0.0, degree=degree)
    energies.append(lambda S: (1 - damage) * PSI(S))
    for psi in energies:
        require_isotropic(psi, S, "this")
