"""The polar rotation against routes that share nothing with it."""

from __future__ import annotations

import gc

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
import scipy.linalg
import ufl
from dolfinx import fem, mesh
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from ufl.algorithms import extract_coefficients

from forms import (
    CellData,
    deformation_gradient,
    displacement_field,
    polar_rotation,
    right_stretch,
)
from forms.rotation import GAP, polar_factors
from tests.states import small_mesh

STEP = 2e-3  # of finite differences
entries = st.floats(-2.0, 2.0, allow_subnormal=False)


class OneCell:
    """One cell with F prescribed: R and S as the UFL expressions give them."""

    def __init__(self, d):
        simplex = np.vstack([np.zeros(d), np.eye(d)])
        first = MPI.COMM_WORLD.rank == 0
        element = basix.ufl.element("P", {2: "triangle", 3: "tetrahedron"}[d], 1, shape=(d,))
        self.mesh = mesh.create_mesh(
            MPI.COMM_WORLD,
            np.array([range(d + 1)] if first else np.empty((0, d + 1)), dtype=np.int64),
            element,
            simplex if first else np.empty((0, d)),
        )
        self.d = d
        self.u = displacement_field(self.mesh)
        points = np.full((1, d), 1.0 / (d + 1))
        self.cells = np.arange(self.mesh.topology.index_map(d).size_local, dtype=np.int32)
        F = deformation_gradient(self.u)
        expression = polar_rotation(F)
        self.data = [c for c in ufl.algorithms.extract_coefficients(expression) if c is not self.u]
        self.R = fem.Expression(expression, points)
        self.S = fem.Expression(right_stretch(F), points)
        self.along = fem.Function(self.u.function_space)
        first = [ufl.derivative(e, self.u, self.along) for e in (expression, right_stretch(F))]
        second = [ufl.derivative(e, self.u, self.along) for e in first]
        self.derivatives = [fem.Expression(e, points) for e in (*first, *second)]

    def evaluate(self, F):
        """R and S; empty arrays on a rank without the cell."""
        return self._evaluated(F, self.R, self.S)

    def differentiate(self, F, D):
        """∂R[D], ∂S[D], ∂²R[D, D] and ∂²S[D, D]."""
        self.along.interpolate(lambda X: D @ X[: self.d])
        return self._evaluated(F, *self.derivatives)

    def _evaluated(self, F, *expressions):
        self.u.interpolate(lambda X: (F - np.eye(self.d)) @ X[: self.d])
        for data in self.data:
            data.refresh()
        return tuple(e.eval(self.mesh, self.cells).reshape(-1, self.d, self.d) for e in expressions)


@pytest.fixture(scope="module", params=[2, 3])
def one_cell(request):
    return OneCell(request.param)


def svd_polar(F):
    """R and S in SO(d) from NumPy's SVD; the smallest singular value takes the sign of det F."""
    U, sigma, Vt = np.linalg.svd(F)
    sign = np.ones(len(F))
    sign[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return U @ np.diag(sign) @ Vt, Vt.T @ np.diag(sign * sigma) @ Vt, sign * sigma


def check(one_cell, F):
    R, S, sigma = svd_polar(F)
    # R is not defined where σ_{d-1} + σ_d = 0, and rounding of F = I + ∂u/∂X grows by its inverse.
    assume(sigma[-1] + sigma[-2] > 0.02)
    for R_ufl, S_ufl in zip(*one_cell.evaluate(F), strict=True):
        np.testing.assert_allclose(R_ufl, R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(S_ufl, S, rtol=0, atol=1e-12 * max(1.0, sigma[0]))


@given(data=st.data())
def test_random(one_cell, data):
    """Any F, det F < 0 included."""
    d = one_cell.d
    check(one_cell, data.draw(hnp.arrays(float, (d, d), elements=entries)))


@given(data=st.data(), size=st.sampled_from([0.0, 1e-15, 1e-8, 1e-3]))
def test_near_rest(one_cell, data, size):
    """F near the identity, where eigenvalue formulas break down."""
    d = one_cell.d
    check(one_cell, np.eye(d) + size * data.draw(hnp.arrays(float, (d, d), elements=entries)))


@given(data=st.data(), stretch=st.floats(1.0, 1e3))
def test_large_stretch(one_cell, data, stretch):
    """One direction stretched up to a thousand times, then rotated at random."""
    d = one_cell.d
    rotation = svd_polar(data.draw(hnp.arrays(float, (d, d), elements=entries)))[0]
    F = rotation @ np.diag([stretch, *[1.0 + 0.1 * k for k in range(1, d)]])
    R, S, _ = svd_polar(F)
    for R_ufl, S_ufl in zip(*one_cell.evaluate(F), strict=True):
        np.testing.assert_allclose(R_ufl, R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(S_ufl, S, rtol=0, atol=1e-12 * stretch)


@pytest.mark.parametrize("mirrored", [False, True])
def test_derivatives(one_cell, mirrored):
    """Against differences of order 6 of NumPy's factors, det F < 0 included."""
    d, rng = one_cell.d, np.random.default_rng(3)
    U, V = (svd_polar(rng.normal(size=(d, d)))[0] for _ in range(2))
    sigma = np.array([1.7, 1.1, 0.4][3 - d :])
    F = U @ np.diag(sigma * [*np.ones(d - 1), -1.0 if mirrored else 1.0]) @ V.T
    D = rng.normal(size=(d, d))
    near = np.array([svd_polar(F + k * STEP * D)[:2] for k in range(-3, 4)])
    first = np.tensordot([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60], near, 1) / STEP
    weights = [1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90]
    second = np.tensordot(weights, near, 1) / STEP**2
    for found, expected in zip(one_cell.differentiate(F, D), (*first, *second), strict=True):
        for value in found:  # none on a rank without the cell
            np.testing.assert_allclose(value, expected, rtol=0, atol=1e-7)


def test_factors():
    """F = R S with S symmetric and R a rotation, and G as it says, det F < 0 included."""
    F = np.random.default_rng(4).normal(size=(20, 3, 3))
    assert 5 < (np.linalg.det(F) < 0.0).sum() < 15
    R, S, G = polar_factors(F)
    np.testing.assert_allclose(R @ S, F, atol=1e-13)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-13)
    np.testing.assert_allclose(S, np.swapaxes(S, 1, 2), atol=1e-13)
    trace = np.trace(S, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(G @ (2 * (trace * np.eye(3) - S)), F * 0.0 + np.eye(3), atol=1e-11)


@given(data=st.data())
def test_agrees_with_scipy(one_cell, data):
    """scipy.linalg.polar takes another route (it allows reflections, so det F > 0 here)."""
    d = one_cell.d
    F = np.eye(d) + 0.4 * data.draw(hnp.arrays(float, (d, d), elements=entries))
    assume(np.linalg.det(F) > 0.05)
    R, S = scipy.linalg.polar(F)
    for R_ufl, S_ufl in zip(*one_cell.evaluate(F), strict=True):
        np.testing.assert_allclose(R_ufl, R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(S_ufl, S, rtol=0, atol=1e-12)


CANCELLING = [
    (0.0, 0.0, 0.0),
    (1.3, 0.0, 0.0),
    (1.2, 0.8, -0.8),
    (1.0, 1.0, -1.0),
    (1e3, 1.0, -1.0),
]


@pytest.mark.parametrize("sigma", CANCELLING)
def test_where_there_are_many_rotations(one_cell, sigma):
    """One of those that maximise tr RᵀF, and derivatives that are finite."""
    d = one_cell.d
    sigma = np.array((sigma[0], -sigma[0]) if d == 2 else sigma, dtype=float)
    U, V = (svd_polar(np.random.default_rng(k).normal(size=(d, d)))[0] for k in (1, 2))
    F = U @ np.diag(sigma) @ V.T
    for R, S in zip(*one_cell.evaluate(F), strict=True):
        np.testing.assert_allclose(R @ R.T, np.eye(d), rtol=0, atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
        assert np.trace(S) == pytest.approx(sigma.sum(), abs=1e-12 * max(1.0, sigma[0]))
    G = polar_factors(np.pad(F, (0, 3 - d))[None])[2]
    assert np.abs(G).max() <= 0.5 / GAP


def test_per_cell_data_are_shared():
    """Two expressions of one deformation gradient use one set of per-cell data."""
    u = displacement_field(small_mesh(3))
    R, S = polar_rotation(deformation_gradient(u)), right_stretch(deformation_gradient(u))
    assert len((ufl.inner(R, S) * ufl.dx).coefficients()) == 2


def test_compiled_forms_of_one_displacement_share_the_data():
    """A form compiled from an expression that is gone follows what another one refreshes."""
    u = displacement_field(small_mesh(3))
    F = deformation_gradient(u)
    trace = fem.form(ufl.tr(polar_rotation(F)) * ufl.dx)
    gc.collect()
    angle = 0.7
    Q = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    u.interpolate(lambda X: (Q - np.eye(3)) @ X)
    (data,) = (c for c in extract_coefficients(polar_rotation(F)) if isinstance(c, CellData))
    data.refresh()
    one = fem.Constant(u.function_space.mesh, 1.0)
    expected = (1 + 2 * np.cos(angle)) * fem.assemble_scalar(fem.form(one * ufl.dx))
    assert np.isclose(fem.assemble_scalar(trace), expected, rtol=1e-12)
