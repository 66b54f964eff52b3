"""Systems of the witness on small bodies, and central differences."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp

from demos.by_hand import (
    Corotational,
    SeedSystem,
    StableNeoHookean,
    State,
    SymmetricSystem,
    solve_kkt,
    symmetric_dofs,
    symmetric_tensor,
)

MU, LAM = 1.3, 2.1  # [Pa]
EPS = 0.7  # [1/Pa]
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])
CHOICES = {
    "seed": lambda *a, **k: SeedSystem(*a, **k),
    "cured": lambda *a, **k: SeedSystem(*a, eps=EPS, **k),
    "symmetric": lambda *a, **k: SymmetricSystem(*a, **k),
}
FORMULATIONS = pytest.mark.parametrize("formulation", list(CHOICES))


def make_mesh(d, rng):
    """A distorted square of four triangles or cube of six tetrahedra."""
    if d == 2:
        X = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.4, 0.6]], dtype=float)
        cells = np.array([[0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]])
    else:
        X = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)
        cells = np.array(
            [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]]
        )
    return X + 0.08 * rng.standard_normal(X.shape), cells


def symmetric_noise(rng, n, d, size):
    noise = size * rng.standard_normal((n, d, d))
    return 0.5 * (noise + np.swapaxes(noise, 1, 2))


def rotation_matrix(d, rng):
    Q, _ = np.linalg.qr(rng.standard_normal((d, d)))
    return Q * np.array([np.sign(np.linalg.det(Q))] + [1.0] * (d - 1))


def make_system(d, formulation, kind="infeasible", material=None, seed=0, **options):
    """A system at rest, at a random feasible state (S = S(F), Λ = R Y) or at a random one."""
    rng = np.random.default_rng(seed)
    X, cells = make_mesh(d, rng)
    n = len(cells)
    if kind == "rest":
        state = State.at_rest(X, cells)
    else:
        gradient = rotation_matrix(d, rng) @ (np.eye(d) + 0.2 * rng.standard_normal((d, d)))
        x = X @ gradient.T + 0.08 * rng.standard_normal(X.shape)
        polar = SymmetricSystem(
            dataclasses.replace(State.at_rest(X, cells), x=x), Corotational(1.0)
        ).polar
        Y = symmetric_noise(rng, n, d, 0.8)
        if kind == "feasible":
            S = symmetric_tensor(symmetric_dofs(polar.S_F))
            Lam = polar.R @ Y
        else:
            S = np.eye(d) + symmetric_noise(rng, n, d, 0.3)
            Lam = rng.standard_normal((n, d, d))
        state = State(X, cells, x, S, Y if formulation == "symmetric" else Lam)
    values = {
        "rho": rng.uniform(0.5, 2.0, n),
        "h": 0.4,
        "v": rng.standard_normal(X.shape),
        "f_ext": rng.standard_normal(d),
        "x_n": state.x + 0.1 * rng.standard_normal(X.shape),
    }
    material = StableNeoHookean(MU, LAM) if material is None else material
    return CHOICES[formulation](state, material, **{**values, **options})


def sizes(system):
    return system.g_x.size, system.g_s.size, system.lam.size


def split(system, vector):
    return np.split(vector, np.cumsum(sizes(system))[:-1])


def random_step(system, seed=1):
    return np.random.default_rng(seed).standard_normal(sum(sizes(system)))


def central(f, direction, step):
    return (f(step * direction) - f(-step * direction)) / (2.0 * step)


def assert_derivative(f, derivative, direction, tolerance=1e-7):
    """Central differences of f at 0 approach the derivative with order 2."""
    scale = max(np.linalg.norm(derivative), 1e-3)
    coarse, fine, finest = (
        np.linalg.norm(central(f, direction, step) - derivative) / scale
        for step in (4e-3, 2e-3, 1e-5)
    )
    assert finest < tolerance
    if coarse > 1e-9:  # else f is quadratic at most and the difference exact
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def relative(a, b):
    a, b = (m.toarray() if sp.issparse(m) else np.asarray(m) for m in (a, b))
    return np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-300)


def deformations(d, seed=0, n=5):
    """Random F: distinct singular values, some inverted, in the d = 3 case not nearly singular."""
    rng = np.random.default_rng(seed)
    U = np.stack([rotation_matrix(d, rng) for _ in range(n)])
    V = np.stack([rotation_matrix(d, rng) for _ in range(n)])
    sigma = np.sort(rng.uniform(0.3, 0.5, (n, d)), axis=1)[:, ::-1] + np.arange(d)[::-1] * 0.5
    sigma[::2, -1] *= -1.0
    return np.einsum("nia,na,nja->nij", U, sigma, V)


def newton(system, fixed, iterations, solve=solve_kkt):
    residuals = []
    free = np.setdiff1d(np.arange(sum(sizes(system))), fixed)
    for _ in range(iterations):
        step = solve(system, fixed)
        system = system.moved(step.dx, step.ds, step.lam - system.lam)
        residuals.append(np.linalg.norm(system.gradient()[free]))
    return system, residuals
