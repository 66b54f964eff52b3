"""The seed's equations in order: what the NumPy witness says of each, and what UFL says.

`items` yields pairs of arrays that must agree. The witness's array comes from `demos.by_hand` and
never from UFL; UFL's comes from assembled derivatives of the energy, and where an equation
eliminates or models, from dense algebra on them. "printed" is the seed's system, Λ full, ε = 0 and
without ∂²c/∂x²; "exact" keeps ∂²c/∂x² and is regular: the seed's with ε = 1/G₀, or `symmetric`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from demos.by_hand import MATERIALS, DiscreteSystem, SeedSystem, SymmetricSystem, lame_parameters
from demos.by_hand.compare.algebra import (
    model_energy,
    parts_of,
    printed_blocks,
    printed_gradient,
    stretch_step,
)
from demos.by_hand.compare.assembly import FIELDS
from demos.by_hand.compare.bodies import E
from demos.by_hand.compare.cases import Case
from demos.by_hand.compare.item import Hook, Item, dense, one
from demos.by_hand.compare.newton import (
    another_eps,
    condensed,
    exact_steps,
    newton_system,
    printed_steps,
)
from demos.by_hand.compare.texts import texts
from demos.by_hand.element import block_diagonal

ANOTHER_EPS = 0.3
"""ε in units of 1/G₀, where it is not 1."""


def items(case: Case, hook: Hook = lambda system: system) -> Iterator[Item]:
    """Every pair to compare in a case.

    Args:
        case: UFL's side.
        hook: Changes each system of the witness before anything is computed from it.
    """
    step = case.step
    common: dict[str, Any] = {
        "state": step.iterate,
        "material": MATERIALS[case.names[2]](*lame_parameters(E, step.nu)),
        "rho": step.rho,
        "h": step.h,
        "v": step.velocity,
        "f_ext": step.f_ext,
        "x_n": step.start,
    }
    if case.names[1] == "seed":
        yield from _seed(case, common, hook)
        return
    exact = hook(SymmetricSystem(**common))
    yield from _exact(case, exact)
    yield from condensed(case, exact)


def _seed(case: Case, common: dict[str, Any], hook: Hook) -> Iterator[Item]:
    """Whatever the seed's own formulation takes part in."""
    eps = 1.0 / common["material"].mu
    printed = hook(SeedSystem(**common, second_derivatives=False))
    yield from _rotation(case, printed)
    yield from _cell_by_cell(case, printed)
    blocks, gradient = printed_blocks(case), printed_gradient(case)
    yield from newton_system(case, printed, "printed", blocks, gradient)
    yield from printed_steps(case, printed, hook(SeedSystem(**common)))
    yield from _exact(case, hook(SeedSystem(**common, eps=eps)))
    other = {**common, "eps": ANOTHER_EPS * eps}
    yield from another_eps(case, hook(SeedSystem(**other)), ANOTHER_EPS)
    yield from texts(case, hook(SeedSystem(**other, second_derivatives=False)), ANOTHER_EPS)


def _exact(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    """What the regular systems of both formulations take part in."""
    yield from _energies(case, w)
    yield from _constraint(case, w)
    yield from _quadratic_model(case, w)
    yield from newton_system(case, w, "exact", case.total.second, case.total.first)
    yield from exact_steps(case, w)


# Sections 1.2 to 2.2: energies


def _energies(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    parts = case.kinetic.value + case.elastic.value - case.constraint.value
    yield Item(2, "energy E", one(w.energy()), one(case.total.value))
    for i, rows in zip(FIELDS, parts_of(case, w.gradient()), strict=True):
        yield Item(2, "∂E, zero where E is stationary", rows, case.total.first[i], i)
    yield Item(5, "E at x + δx, s + δs, λ + δλ", one(w.moved(dx, ds, dl).energy()), one(case.moved))
    printed = w.E_M() + w.E_Psi() - w.E_Lambda()
    yield Item(6, "E_M + E_Ψ - E_Λ, summed by UFL", one(printed), one(parts))
    yield Item(7, "E_M", one(w.E_M()), one(case.kinetic.value))
    value, slope = case.first_iteration
    h = w.h
    y = dx - np.ravel(h * case.step.velocity + h**2 * case.step.f_ext)
    yield Item(8, "E_M at x^t + δx, first iteration", one(y @ (w.M @ y) / (2 * h**2)), one(value))
    yield Item(9, "∂E_M/∂δx, first form, first iteration", w.M @ y / h**2, slope)
    K = case.kinetic.second["xx"]
    yield Item(9, "g_x = M (x - x̃)/h²", w.g_x, case.kinetic.first["x"])
    yield Item(9, "M/h²", dense(w.M) / h**2, K)
    g, K = case.elastic.first["s"], case.elastic.second["ss"]
    s = ds.reshape(w.s.shape)
    density = w.material.psi(w.s) + np.sum(w.g_K * s, axis=1)
    density = density + 0.5 * np.einsum("ni,nij,nj->n", s, w.H_K, s)
    model = case.elastic.value + g @ ds + 0.5 * ds @ K @ ds
    yield Item(10, "model of E_Ψ", one(w.volume @ density), one(model))
    slope_s = w.volume[:, None] * (w.g_K + np.einsum("nij,nj->ni", w.H_K, s))
    yield Item(11, "V_K (g_K + H_K δs_K)", slope_s.ravel(), g + K @ ds)


# Section 2.3: the constraint


def _rotation(case: Case, w: SeedSystem) -> Iterator[Item]:
    """(3), (4) and (14)-(17), cell by cell; UFL's integrals carry V_K."""
    V, n, kin = w.volume[:, None], len(w.W), case.kinematics
    d2 = w.d**2
    yield Item(3, "vec(R_K S_K)", (V * np.einsum("nik,nk->ni", w.W, w.s)).ravel(), kin["RS"])
    vec_F = w.J @ w.state.x.ravel()
    yield Item(4, "J_K x", (V * vec_F.reshape(n, -1)).ravel(), kin["F"])
    yield Item(4, "J_K", dense(w.J_w), kin["J"])
    yield Item(14, "R_K", (V * w.polar.R.reshape(n, -1)).ravel(), kin["R"])
    U, sigma, V_K = w.polar.svd
    product = np.einsum("nia,na,nja->nij", U, sigma, V_K)
    yield Item(14, "U Σ Vᵀ", (V * product.reshape(n, -1)).ravel(), kin["F"])
    dR = block_diagonal(w.polar.dR.reshape(n, d2, d2)) @ w.J_w
    yield Item(15, "∂R_K/∂x, closed form", dense(dR), kin["dR"])
    if case.names[3] != "rest":  # where σ are distinct
        (U, _, V_K), (dU, dV) = w.polar.svd, w.polar.svd_derivatives
        sum_15 = np.einsum("niakl,nja->nijkl", dU, V_K) + np.einsum("nia,njakl->nijkl", U, dV)
        dR = block_diagonal(sum_15.reshape(n, d2, d2)) @ w.J_w
        yield Item(15, "∂U Vᵀ + U ∂Vᵀ, distinct σ", dense(dR), kin["dR"])
    yield Item(16, "W_K", dense(block_diagonal(V[:, None] * w.W)), kin["W"])
    W_hat = [
        dense(block_diagonal(np.swapaxes(w.W_hat[..., k], 1, 2)) @ w.J_w)
        for k in range(w.W_hat.shape[-1])
    ]
    yield Item(17, "Ŵ_K, times J_K", np.array(W_hat), kin["W_hat"])


def _constraint(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    """(12), (13) and (18)-(24), volume-weighted."""
    first, second = case.constraint.first, case.constraint.second
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    yield Item(12, "E_Λ", one(w.E_Lambda()), one(case.constraint.value))
    model: Any = w.E_Lambda() + dx @ w.E_x + ds @ w.E_s + dl @ w.c
    model -= dl @ (w.D @ ds) + dl @ (w.G @ dx) + ds @ (w.F @ dx) - 0.5 * dx @ (w.E_xx @ dx)
    expected: Any = case.constraint.value + sum(first[i] @ case.delta[i] for i in FIELDS)
    expected += sum(case.delta[i] @ second[i + j] @ case.delta[j] for i, j in ("ls", "lx", "sx"))
    expected += 0.5 * dx @ second["xx"] @ dx
    yield Item(13, "model of E_Λ", one(model), one(expected))
    yield Item(18, "∂E_Λ/∂x", w.E_x, first["x"])
    yield Item(19, "∂E_Λ/∂s", w.E_s, first["s"])
    yield Item(20, "∂E_Λ/∂λ", w.c, first["l"])
    if isinstance(w, SeedSystem):
        identity = np.eye(w.W_hat_s.shape[1])
        blocks = {
            21: block_diagonal(w.volume[:, None, None] * w.W),
            22: w.J_w.T @ block_diagonal(w.W_hat_s - identity),
            23: w.J_w.T @ block_diagonal(w.W_hat_lam),
        }
    else:
        blocks = {21: -w.D, 22: -w.G.T, 23: -w.F.T}
    yield Item(21, "∂²E_Λ/∂λ∂s", dense(blocks[21]), second["ls"])
    yield Item(22, "∂²E_Λ/∂x∂λ", dense(blocks[22]), second["xl"])
    yield Item(23, "∂²E_Λ/∂x∂s", dense(blocks[23]), second["xs"])
    yield Item(24, "∂²E_Λ/∂x²", dense(w.E_xx), second["xx"])


# Sections 3 and 4.1 to 4.3: the model of the energy and its derivatives


def _quadratic_model(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    """(26), the display before it, and (27), by blocks; UFL's by its own second derivatives."""
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    new = w.lam + dl
    energy = w.E_M() + w.E_Psi()
    squares: Any = 0.5 * ds @ (w.H @ ds) + 0.5 * dx @ (w.M @ dx) / w.h**2
    value: Any = energy + dx @ w.g_x + ds @ w.g_s - new @ w.c
    value += ds @ (w.F @ dx) + new @ (w.G @ dx + w.D @ ds) + squares
    before: Any = energy - w.E_Lambda() + dx @ (w.g_x - w.E_x) + ds @ (w.g_s - w.E_s) - dl @ w.c
    before += ds @ (w.F @ dx) + dl @ (w.G @ dx + w.D @ ds) + squares - 0.5 * dx @ (w.E_xx @ dx)
    expected = model_energy(case)
    E_xx = case.constraint.second["xx"]
    yield Item(26, "model of E", one(value), one(expected))
    yield Item(26, "the display before it", one(before), one(expected - 0.5 * dx @ E_xx @ dx))
    yield Item(27, "model of E, in δx, δs, λ", one(value), one(expected))


def _cell_by_cell(case: Case, w: SeedSystem) -> Iterator[Item]:
    """(28)-(31) by the formulas of the seed; UFL's by differentiating its model."""
    V, n = w.volume[:, None], len(w.W)
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    s, x = ds.reshape(n, -1), (w.J @ dx).reshape(n, -1)
    new = (w.lam + dl).reshape(n, -1)
    bend = w.W_hat_s - np.eye(w.W_hat_s.shape[1])
    K = printed_blocks(case)
    lam = w.lam + dl
    pull = np.einsum("njl,nl->nj", w.W_hat_lam, s) + np.einsum("njk,nk->nj", bend, new)
    eq_28 = w.M @ dx / w.h**2 + w.g_x - w.J_w.T @ pull.ravel()
    expected = K["xx"] @ dx + case.kinetic.first["x"] + K["xs"] @ ds + K["xl"] @ lam
    yield Item(28, "∂Ẽ/∂δx", eq_28, expected)
    pull = np.einsum("nij,ni->nj", w.W, new) + np.einsum("njl,nj->nl", w.W_hat_lam, x)
    eq_29 = w.g_K + np.einsum("nij,nj->ni", w.H_K, s) - pull
    g_s = case.elastic.first["s"]
    expected = g_s + K["ss"] @ ds + K["sl"] @ lam + K["sx"] @ dx
    yield Item(29, "V_K ∂Ẽ/∂δs", (V * eq_29).ravel(), expected)
    eq_30 = np.linalg.solve(w.H_K, (pull - w.g_K)[..., None]).ravel()
    yield Item(30, "δs of δx and λ", eq_30, stretch_step(case, K, dx, lam))
    eq_31 = -w.c_K - np.einsum("njk,nj->nk", bend, x) - np.einsum("nik,nk->ni", w.W, s)
    expected = -case.constraint.first["l"] + K["lx"] @ dx + K["ls"] @ ds
    yield Item(31, "V_K ∂Ẽ/∂λ", (V * eq_31).ravel(), expected)
