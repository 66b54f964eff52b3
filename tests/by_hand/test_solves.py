"""Rank of the hand-derived system, its eliminations, and Newton's method with it."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

from demos.by_hand import (
    MATERIALS,
    SeedSystem,
    StableNeoHookean,
    State,
    skew_basis,
    solve_condensed,
    solve_kkt,
    solve_printed,
    solve_reduced,
)
from demos.by_hand.element import block_diagonal
from tests.by_hand.systems import (
    CHOICES,
    DIMENSIONS,
    EPS,
    FORMULATIONS,
    LAM,
    MU,
    make_mesh,
    make_system,
    newton,
    relative,
    rotation_matrix,
    sizes,
    symmetric_noise,
)

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks


def nullity(matrix):
    singular = np.linalg.svd(matrix.toarray(), compute_uv=False)
    return np.count_nonzero(singular < 1e-13 * singular[0])


@DIMENSIONS
@pytest.mark.parametrize("kind", ["rest", "feasible"])
def test_printed_system_has_a_null_space_and_the_cured_one_none(d, kind):
    """(35) and (41): d (d - 1) / 2 null vectors a cell, Λ = R skew, at feasible states."""

    printed = make_system(d, "seed", kind)
    spins = d * (d - 1) // 2
    expected = spins * len(printed.state.cells)
    assert nullity(printed.kkt()[0]) == expected
    assert nullity(printed.reduced()[0]) == expected
    RE = np.einsum("nik,akj->naij", printed.polar.R, skew_basis(d))
    for a in range(spins):
        null = np.zeros(sum(sizes(printed)))
        null[-printed.lam.size :] = RE[:, a].ravel()
        np.testing.assert_allclose(printed.kkt()[0] @ null, 0.0, atol=1e-14)
    for formulation in ("cured", "symmetric"):
        system = make_system(d, formulation, kind)
        assert nullity(system.kkt()[0]) == nullity(system.reduced()[0]) == 0


@DIMENSIONS
def test_printed_schur_complement_is_rank_deficient_at_every_state(d):
    system = make_system(d, "seed", "infeasible")
    rank = np.linalg.matrix_rank(system.DHD.toarray(), tol=1e-11)
    assert rank == len(system.state.cells) * d * (d + 1) // 2


def one_cell(system, **changes):
    """A system on the first cell's vertices alone."""
    state, d = system.state, system.d
    X, cells = state.X[: d + 1], np.arange(d + 1)[None]
    one = State(X, cells, state.x[: d + 1], state.S[:1], state.Lam[:1])
    return SeedSystem(one, system.material, h=0.4, f_ext=np.arange(d), **changes)


@DIMENSIONS
def test_printed_system_freezes_rotations_at_infeasible_states(d):
    """Its rows on R skew demand (tr(S - S_F) I - (S - S_F)) ω = 0 of the rotation increment."""
    system = make_system(d, "seed", "infeasible")
    spin = {}
    for eps, solve in ((0.0, solve_printed), (EPS, solve_kkt)):
        single = one_cell(system, eps=eps)
        step = solve(single)
        matrix, rhs = single.kkt()
        np.testing.assert_allclose(
            matrix @ np.concatenate([step.dx, step.ds, step.lam]), rhs, atol=1e-10
        )
        spin[eps] = np.abs(single.polar.spin.reshape(-1, d * d) @ (single.J @ step.dx)).max()
    assert spin[0.0] < 1e-10
    assert spin[EPS] > 1e-3


@DIMENSIONS
@pytest.mark.parametrize("kind", ["feasible", "infeasible"])
def test_printed_step_solves_the_printed_system_with_the_smallest_multiplier(d, kind):
    """At any state, against a dense least-squares solution."""
    system = make_system(d, "seed", kind, second_derivatives=False)
    matrix, rhs = system.kkt()
    step = solve_printed(system)
    found = np.concatenate([step.dx, step.ds, step.lam])
    np.testing.assert_allclose(matrix @ found, rhs, atol=1e-9)
    null = scipy.linalg.null_space(matrix.toarray(), rcond=1e-13)
    assert null.shape[1] == nullity(matrix)
    np.testing.assert_allclose(null.T @ found, 0.0, atol=1e-7 * np.linalg.norm(found))


def test_printed_system_of_tetrahedra_is_singular_at_infeasible_states_too():
    """The 3 n_e multipliers R skew push n vertices in 3 n - 4 ways: never to move or to dilate.

    A cube of 48 tetrahedra, each a path along the edges of one of eight smaller cubes.
    """
    X = np.indices((3, 3, 3)).reshape(3, -1).T
    edges = np.eye(3, dtype=int)
    paths = [
        np.cumsum([corner, *edges[list(order)]], axis=0)
        for corner in np.indices((2, 2, 2)).reshape(3, -1).T
        for order in itertools.permutations(range(3))
    ]
    cells = np.array(paths) @ (9, 3, 1)
    rng = np.random.default_rng(0)
    n, n_e = len(X), len(cells)
    x = X @ rotation_matrix(3, rng).T + 0.1 * rng.standard_normal(X.shape)
    S = np.eye(3) + symmetric_noise(rng, n_e, 3, 0.3)
    state = State(X, cells, x, S, rng.standard_normal((n_e, 3, 3)))
    system = SeedSystem(state, StableNeoHookean(MU, LAM), second_derivatives=False)
    RE = np.einsum("nik,akj->naij", system.polar.R, skew_basis(3)).reshape(n_e, 3, 9)
    pushes = (system.G.T @ block_diagonal(np.swapaxes(RE, 1, 2))).toarray()
    assert 3 * n_e - np.linalg.matrix_rank(pushes) == 3 * n_e - 3 * n + 4 > 3 * (n_e - n)
    still = np.column_stack([np.tile(np.eye(3), (n, 1)), x.ravel()])
    np.testing.assert_allclose(still.T @ pushes, 0.0, atol=1e-12)
    assert np.linalg.norm(pushes, axis=0).min() > 1e-4
    np.testing.assert_allclose(
        (system.D.T @ block_diagonal(np.swapaxes(RE, 1, 2))).toarray(), 0.0, atol=1e-14
    )


@DIMENSIONS
def test_the_block_of_the_cure_alone_has_the_same_limit_but_is_slower(d):
    """(35) with C_ε in place of 0 and nothing else: superlinear, where the whole is quadratic."""
    X, cells = make_mesh(d, np.random.default_rng(0))
    fixed = np.arange(2 * d)
    ways = {
        "whole": lambda w: w,
        "block": lambda w: w.with_blocks(
            A=(w.M / w.h**2 - w.E_xx).tocsr(), G_lhs=w.G, rhs_x=-w.g_x
        ),
    }
    limits, residuals = {}, {}
    for name, change in ways.items():
        start = State.at_rest(X, cells)
        w = SeedSystem(start, StableNeoHookean(1.0, 2.0), 1.0, 0.5, f_ext=-2.0, eps=1.0)
        residuals[name] = []
        while not residuals[name] or residuals[name][-1] > 1e-12:
            step = solve_kkt(change(w), fixed)
            w = w.moved(step.dx, step.ds, step.lam - w.lam)
            free = np.setdiff1d(np.arange(sum(sizes(w))), fixed)
            residuals[name].append(np.linalg.norm(w.gradient()[free]))
            assert len(residuals[name]) < 12
        limits[name] = w.state
    for unknown in ("x", "S", "Lam"):
        same = relative(getattr(limits["block"], unknown), getattr(limits["whole"], unknown))
        assert same < 1e-10, unknown
    assert len(residuals["block"]) > len(residuals["whole"])
    for a, b, c in zip(*(residuals["block"][k:] for k in range(3)), strict=False):
        if c > 1e-13:
            assert c < 20.0 * a * b  # as the secant method: order 1.6


@DIMENSIONS
@FORMULATIONS
@pytest.mark.parametrize("kind", ["feasible", "infeasible"])
@pytest.mark.parametrize("second", [True, False])
def test_reduced_system_and_back_substitution_give_the_full_step(d, formulation, kind, second):
    """(41) with (36) solves (35), with clamped vertices."""
    system = make_system(d, formulation, kind, second_derivatives=second)
    fixed = np.arange(2 * d)
    full, reduced = solve_kkt(system, fixed), solve_reduced(system, fixed)
    for name in ("dx", "ds", "lam"):
        assert relative(getattr(reduced, name), getattr(full, name)) < 1e-11
    assert not np.any(full.dx[fixed])
    if formulation == "symmetric":
        condensed = solve_condensed(system, fixed)
        for name in ("dx", "ds", "lam"):
            assert relative(getattr(condensed, name), getattr(full, name)) < 1e-11


@DIMENSIONS
def test_condensed_matrix_is_the_schur_complement(d):
    system = make_system(d, "symmetric")
    matrix, rhs = (m.toarray() if sp.issparse(m) else m for m in system.kkt())
    n = system.g_x.size
    eliminate = np.linalg.solve(matrix[n:, n:], np.column_stack([matrix[n:, :n], rhs[n:]]))
    K, b = system.condensed()
    assert relative(K, matrix[:n, :n] - matrix[:n, n:] @ eliminate[:, :-1]) < 1e-12
    assert relative(b, rhs[:n] - matrix[:n, n:] @ eliminate[:, -1]) < 1e-12


@DIMENSIONS
def test_printed_system_is_solved_with_the_smallest_multiplier(d):
    """At a feasible state, against a dense least-squares solution of (35)."""
    system = make_system(d, "seed", "feasible")
    matrix, rhs = system.kkt()
    expected = np.linalg.lstsq(matrix.toarray(), rhs, rcond=1e-12)[0]
    np.testing.assert_allclose(matrix @ expected, rhs, atol=1e-11)
    step = solve_kkt(system)
    assert relative(np.concatenate([step.dx, step.ds, step.lam]), expected) < 1e-10


@DIMENSIONS
@pytest.mark.parametrize("name", list(MATERIALS))
def test_seed_and_symmetric_take_the_same_step_at_a_feasible_state(d, name):
    """δx, δs and the variation of sym(RᵀΛ), which is δY; Newton is invariant where c = 0."""
    material = MATERIALS[name](MU, LAM)
    seeds = [make_system(d, f, "feasible", material) for f in ("seed", "cured")]
    symmetric = make_system(d, "symmetric", "feasible", material)
    expected = solve_kkt(symmetric)
    Y = symmetric.multiplier_tensor(expected.lam)
    for system in seeds:
        step = solve_kkt(system)
        assert relative(step.dx, expected.dx) < 1e-10
        assert relative(step.ds, expected.ds) < 1e-10
        R = system.polar.R
        dF = (system.J @ step.dx).reshape(R.shape)
        dR = np.einsum("nijkl,nkl->nij", system.polar.dR, dF)
        product = np.swapaxes(R, 1, 2) @ system.multiplier_tensor(step.lam)
        product += np.swapaxes(dR, 1, 2) @ system.state.Lam
        assert relative(0.5 * (product + np.swapaxes(product, 1, 2)), Y) < 1e-10


@DIMENSIONS
def test_newton_converges_quadratically_to_one_state_in_all_formulations(d):
    """Without ∂²R, as printed, it is linear."""
    rng = np.random.default_rng(0)
    X, cells = make_mesh(d, rng)
    fixed = np.arange(2 * d)
    final = {}
    for formulation in CHOICES:
        make = CHOICES[formulation]
        system = make(
            State.at_rest(X, cells), StableNeoHookean(1.0, 2.0), 1.0, 0.5, f_ext=np.full(d, -2.0)
        )
        final[formulation], residuals = newton(system, fixed, 9)
        assert residuals[-1] < 1e-12
        small = [r for r in residuals if 1e-12 < r < 1e-1]
        assert all(b < 20.0 * a**1.8 for a, b in itertools.pairwise(small))
        printed = dataclasses.replace(system, second_derivatives=False)
        _, slow = newton(printed, fixed, 9)
        assert slow[-1] > 1e3 * residuals[-1]
        assert slow[-1] < 0.5 * slow[-2]
    reference = final["symmetric"]
    for formulation in ("seed", "cured"):
        assert relative(final[formulation].state.x, reference.state.x) < 1e-11
        assert relative(final[formulation].state.S, reference.state.S) < 1e-11
        P = np.swapaxes(final[formulation].polar.R, 1, 2) @ final[formulation].state.Lam
        assert relative(P, reference.Y) < 1e-9
