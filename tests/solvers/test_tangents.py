"""What the engine can put in the place of the exact tangent of a displacement."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import BackwardEuler, Corotational, displacement, lame_parameters
from solvers.engine.system import EngineProblem
from tests.states import dense, random_values, small_mesh

E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4


@pytest.fixture(scope="module")
def system():
    """A plane body far from rest."""
    V = fem.functionspace(small_mesh(2), ("Lagrange", 1, (2,)))
    u = fem.Function(V, name="u")
    kinetic = BackwardEuler(u, H).kinetic(RHO)
    energy = (displacement(u, Corotational(E, NU)) + kinetic) * ufl.dx
    return EngineProblem(energy, [u], [], "tangents_")


def K(system, projection=0, marks=None, inertia=1.0):
    """The matrix at the present state."""
    system.projection, system.marks, system.inertia = projection, marks, inertia
    system.residual(system.b)
    system.jacobian(system.b)
    return dense(system.K)


def marked(system, choose):
    """Marks of the cells whose original numbers are chosen."""
    cells = system.fields[0].function_space.mesh.topology.original_cell_index
    return np.array(choose(cells), dtype=np.int8)


def test_marked_cells_alone_are_projected(system):
    """Half of the cells and the other half make up for all; some had negative eigenvalues."""
    (u,) = system.fields
    u.x.array[:] = 0.5 * random_values(u, 1)
    exact, clamped, absolute = (K(system, projection) for projection in (0, 1, 2))
    assert np.linalg.eigvalsh(clamped - exact)[-1] > 0.1 * E
    np.testing.assert_allclose(absolute - exact, 2 * (clamped - exact), atol=1e-12 * E)
    even, odd = (marked(system, lambda c, k=k: c % 2 == k) for k in (0, 1))
    for projection, whole in ((1, clamped), (2, absolute)):
        halves = [K(system, projection, marks) for marks in (even, odd)]
        assert all(np.abs(half - exact).max() > 0.01 * E for half in halves)
        np.testing.assert_allclose(sum(halves) - exact, whole, atol=1e-12 * E)
    np.testing.assert_allclose(K(system, 1, marked(system, lambda c: c < 0)), exact, atol=0)


def test_inertia_counts_as_often_as_asked(system):
    """The difference is the mass matrix over h²."""
    (u,) = system.fields
    du, v = ufl.TrialFunction(u.function_space), ufl.TestFunction(u.function_space)
    mass = fem.petsc.assemble_matrix(fem.form(RHO / H**2 * ufl.inner(du, v) * ufl.dx))
    mass.assemble()
    np.testing.assert_allclose(K(system, inertia=3.0) - K(system), 2 * dense(mass), rtol=1e-12)


def test_a_multiple_of_the_identity_is_a_weighted_laplacian(system):
    """By the modulus of uniaxial strain at rest."""
    (u,) = system.fields
    u.x.array[:] = 0.0
    mu, lam = lame_parameters(E, NU)
    du, v = ufl.TrialFunction(u.function_space), ufl.TestFunction(u.function_space)
    laplacian = (2 * mu + lam) * ufl.inner(ufl.grad(du), ufl.grad(v))
    A = fem.petsc.assemble_matrix(fem.form((laplacian + RHO / H**2 * ufl.inner(du, v)) * ufl.dx))
    A.assemble()
    np.testing.assert_allclose(K(system, 3), dense(A), atol=1e-12 * E)
