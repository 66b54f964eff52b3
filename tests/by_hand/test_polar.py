"""The rotation and stretch by hand against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from demos.by_hand import ERRATA, Polar, signed_svd, skew_basis
from tests.by_hand.systems import (
    DIMENSIONS,
    assert_derivative,
    deformations,
    relative,
    symmetric_noise,
)

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks


@DIMENSIONS
def test_polar_decomposition_of_inverted_cells_too(d):
    """Eq. (14) holds with U and V in SO(d); with σ ≥ 0 R is a reflection where det F < 0."""
    assert ERRATA[13].verdict == "corrected"
    F = deformations(d)
    polar = Polar(F)
    identity = np.broadcast_to(np.eye(d), F.shape)
    np.testing.assert_allclose(np.swapaxes(polar.R, 1, 2) @ polar.R, identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(polar.R), 1.0)
    np.testing.assert_allclose(polar.R @ polar.S_F, F, atol=1e-14)
    np.testing.assert_allclose(polar.S_F, np.swapaxes(polar.S_F, 1, 2), atol=1e-14)
    U, _, Vt = np.linalg.svd(F)
    np.testing.assert_allclose(np.linalg.det(U @ Vt), np.sign(np.linalg.det(F)))
    assert np.any(np.linalg.det(F) < 0) and np.any(np.linalg.det(F) > 0)


@DIMENSIONS
def test_derivatives_of_singular_vectors(d):
    F = deformations(d)
    U0, _, V0 = signed_svd(F)
    direction = np.random.default_rng(1).standard_normal(F.shape)

    def vectors(dF):
        U, _, V = signed_svd(F + dF)
        sign = np.sign(np.einsum("nia,nia->na", U, U0))[:, None, :]  # pairs (u, v) have a free sign
        return np.stack([U * sign, V * sign])

    np.testing.assert_allclose(vectors(0.0 * F), np.stack([U0, V0]), atol=1e-14)
    dU, dV = Polar(F).svd_derivatives
    derivative = np.einsum("mnijkl,nkl->mnij", np.stack([dU, dV]), direction)
    assert_derivative(vectors, derivative, direction)


@DIMENSIONS
def test_equation_15_and_its_closed_form(d):
    """∂U Vᵀ + U ∂Vᵀ is the closed form at distinct σ; at rest ∂U and ∂V do not exist."""
    assert ERRATA[14].verdict == "holds as printed"
    polar = Polar(deformations(d))
    U, _, V = polar.svd
    dU, dV = polar.svd_derivatives
    printed = np.einsum("niakl,nja->nijkl", dU, V) + np.einsum("nia,njakl->nijkl", U, dV)
    assert relative(polar.dR, printed) < 1e-12
    with pytest.raises(ValueError, match="two singular values agree"):
        _ = Polar(np.eye(d)[None]).svd_derivatives


@DIMENSIONS
@pytest.mark.parametrize("at", ["rest", "random"])
def test_derivatives_of_rotation_and_stretch(d, at):
    F = deformations(d) if at == "random" else np.eye(d)[None]
    polar = Polar(F)
    direction = np.random.default_rng(1).standard_normal(F.shape)
    for name in ("R", "S_F"):
        derivative = np.einsum("nijkl,nkl->nij", getattr(polar, f"d{name}"), direction)
        assert_derivative(lambda dF, name=name: getattr(Polar(F + dF), name), derivative, direction)
    spin = np.einsum("nakl,nkl,aij->nij", polar.spin, direction, skew_basis(d))
    np.testing.assert_allclose(
        polar.R @ spin, np.einsum("nijkl,nkl->nij", polar.dR, direction), atol=1e-12
    )


@DIMENSIONS
@pytest.mark.parametrize("at", ["rest", "random"])
def test_second_derivatives_of_rotation_and_stretch(d, at):
    """The core of eq. (24), at rest and in inverted cells."""
    assert ERRATA[23].verdict == "corrected"
    F = deformations(d) if at == "random" else np.eye(d)[None]
    rng = np.random.default_rng(1)
    B, direction = rng.standard_normal((2, *F.shape))
    Y = B + np.swapaxes(B, 1, 2)
    for tensor, name, hessian in (
        (B, "R", Polar(F).rotation_hessian(B)),
        (Y, "S_F", Polar(F).stretch_hessian(Y)),
    ):
        np.testing.assert_allclose(hessian, np.swapaxes(hessian, 1, 2), atol=1e-13)

        def gradient(dF, tensor=tensor, name=name):
            """By the first derivative alone, which has its own test."""
            d_name = getattr(Polar(F + dF), f"d{name}")
            return np.einsum("nij,nijkl->nkl", tensor, d_name).reshape(len(F), -1)

        derivative = np.einsum("npq,nq->np", hessian, direction.reshape(len(F), -1))
        assert_derivative(gradient, derivative, direction)
    np.testing.assert_allclose(
        Polar(F).rotation_gradient(B), np.einsum("nij,nijkl->nkl", B, Polar(F).dR), atol=1e-12
    )
    np.testing.assert_allclose(
        Polar(F).stretch_gradient(Y), np.einsum("nij,nijkl->nkl", Y, Polar(F).dS_F), atol=1e-12
    )


@DIMENSIONS
def test_stretch_hessian_equals_the_form_with_a_sylvester_equation(d):
    """Y : ∂²S = 2 Z : (δFᵀδF - δS δS) with Z S + S Z = Y."""
    F = np.abs(np.linalg.det(deformations(d)))[:, None, None] * 0.2 * np.eye(d) + deformations(d, 3)
    polar = Polar(F)
    rng = np.random.default_rng(1)
    Y = symmetric_noise(rng, len(F), d, 1.0)
    dF = rng.standard_normal(F.shape)
    _, sigma, V = polar.svd
    VYV = np.einsum("nia,nij,njb->nab", V, Y, V) / (sigma[:, :, None] + sigma[:, None, :])
    Z = np.einsum("nia,nab,njb->nij", V, VYV, V)
    dS = np.einsum("nijkl,nkl->nij", polar.dS_F, dF)
    expected = 2 * np.einsum("nij,nij->n", Z, np.swapaxes(dF, 1, 2) @ dF - dS @ dS)
    vec = dF.reshape(len(F), -1)
    actual = np.einsum("np,npq,nq->n", vec, polar.stretch_hessian(Y), vec)
    np.testing.assert_allclose(actual, expected, rtol=1e-10)


def test_rotation_derivative_is_refused_where_the_rotation_is_not_unique():
    with pytest.raises(ValueError, match=r"not unique .* cells \[1\]"):
        _ = Polar(np.stack([np.eye(3), np.diag([1.0, 1.0, -1.0])])).dR
