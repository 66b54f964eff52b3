"""Stresses against closed forms and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem

from forms import (
    Hencky,
    StableNeoHookean,
    StVenantKirchhoff,
    cauchy_stress,
    deformation_gradient,
    displacement_field,
    first_piola_kirchhoff_stress,
    refresh,
    right_stretch,
    von_mises_stress,
)
from tests.states import random_values, small_mesh

E, NU = 10.0, 0.3
LAME = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))


def at(d, *expressions_of):
    """F and expressions of it far from rest on each cell."""
    msh = small_mesh(d)
    u = displacement_field(msh)
    u.x.array[:] = 0.06 * random_values(u, 3)
    F = deformation_gradient(u)
    cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)
    points = np.full((1, d), 1 / (d + 1))
    expressions = [F, *(expression_of(F) for expression_of in expressions_of)]
    refresh(expressions)
    return [fem.Expression(e, points).eval(msh, cells)[:, 0] for e in expressions]


@pytest.mark.parametrize("d", [2, 3])
def test_first_piola_kirchhoff_is_the_derivative_by_F(d):
    """R ∂Ψ/∂S at S(F) is ∂Ψ/∂F: μ F + (λ (J - 1) - μ) cof F of stable neo-Hookean."""
    psi = StableNeoHookean(E, NU)
    F, P = at(d, lambda F: first_piola_kirchhoff_stress(F, psi))
    J = np.linalg.det(F)[:, None, None]
    cofactor = J * np.linalg.inv(F).transpose(0, 2, 1)
    mu, lam = LAME
    np.testing.assert_allclose(P, mu * F + (lam * (J - 1) - mu) * cofactor, atol=1e-12 * E)


@pytest.mark.parametrize("d", [2, 3])
def test_cauchy_of_hencky(d):
    """J σ = 2 μ log V + λ ln J I, V = √(F Fᵀ)."""
    psi = Hencky(E, NU)
    F, sigma = at(d, lambda F: cauchy_stress(F, first_piola_kirchhoff_stress(F, psi)))
    lam2, n = np.linalg.eigh(F @ F.transpose(0, 2, 1))
    log_V = np.einsum("nik,nk,njk->nij", n, np.log(lam2) / 2, n)
    J = np.linalg.det(F)[:, None, None]
    mu, lam = LAME
    expected = (2 * mu * log_V + lam * np.log(J) * np.eye(d)) / J
    np.testing.assert_allclose(sigma, expected, atol=1e-12 * E)


@pytest.mark.parametrize("d", [2, 3])
def test_von_mises(d):
    """Against principal Cauchy stresses; in 2D with that of the plane strain direction."""
    psi = StVenantKirchhoff(E, NU)
    F, von_mises = at(d, lambda F: von_mises_stress(right_stretch(F), psi))
    stretches = np.ones((len(F), 3))
    stretches[:, :d] = np.linalg.svd(F, compute_uv=False)
    green = (stretches**2 - 1) / 2
    mu, lam = LAME
    J = stretches.prod(axis=1, keepdims=True)
    sigma = stretches**2 * (2 * mu * green + lam * green.sum(axis=1, keepdims=True)) / J
    s1, s2, s3 = sigma.T
    expected = np.sqrt(((s1 - s2) ** 2 + (s2 - s3) ** 2 + (s3 - s1) ** 2) / 2)
    np.testing.assert_allclose(von_mises, expected, rtol=1e-11)
