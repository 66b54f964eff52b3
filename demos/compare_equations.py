"""The seed's equations in order: what the NumPy witness says of each, and what UFL says.

`items` yields pairs of arrays that must agree. The witness's array comes from `forms.discrete` and
never from UFL; UFL's comes from assembled derivatives of the energy, and where an equation
eliminates or models, from dense algebra on them. "printed" is the seed's system, Λ full, ε = 0 and
without ∂²c/∂x²; "exact" keeps ∂²c/∂x² and is regular: the seed's with ε = 1/G₀, or `symmetric`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from demos.compare_assembly import FIELDS, Array
from demos.compare_cases import ACCELERATION, NU, RHO, Case, E, H
from forms import MATERIALS as UFL_MATERIALS
from forms.discrete import (
    MATERIALS,
    DiscreteSystem,
    SeedSystem,
    Step,
    SymmetricSystem,
    solve_condensed,
    solve_kkt,
    solve_reduced,
)
from forms.discrete.element import block_diagonal

STEP_TOLERANCE = 1e-9
"""Largest relative difference of a Newton step, solved by two linear solvers."""

CONDENSED = 0
"""In place of an equation's number: the system that the symmetric formulation condenses to."""


class Item(NamedTuple):
    """Two arrays that must agree.

    Attributes:
        equation: Number in the seed, or `CONDENSED`.
        what: What is compared.
        witness: From `forms.discrete`.
        expected: From UFL.
        part: Which of the arrays of one row.
        tolerance: Largest relative difference, `None` for that of the whole comparison.
    """

    equation: int
    what: str
    witness: Array
    expected: Array
    part: str = ""
    tolerance: float | None = None


Blocks = Mapping[str, Array]
Hook = Callable[[Any], Any]  # from a `DiscreteSystem` to one of the same kind


def items(case: Case, hook: Hook = lambda system: system) -> Iterator[Item]:
    """Every pair to compare in a case.

    Args:
        case: UFL's side.
        hook: Changes each system of the witness before anything is computed from it.
    """
    formulation, material, state = case.names[1:]
    parameters = UFL_MATERIALS[material](E, NU)
    common: dict[str, Any] = {
        "state": case.iterate,
        "material": MATERIALS[material](parameters.mu, parameters.lam),
        "rho": RHO,
        "h": H,
        "v": case.velocity,
        "f_ext": np.array(ACCELERATION),
        "x_n": case.start,
    }
    if formulation == "seed":
        printed = hook(SeedSystem(**common, second_derivatives=False))
        exact = hook(SeedSystem(**common, eps=1.0 / parameters.mu))
        yield from _rotation(case, printed)
        yield from _cell_by_cell(case, printed)
        yield from _newton_system(
            case, printed, "printed", _printed_blocks(case), _printed_gradient(case)
        )
        if state != "infeasible":
            yield from _printed_step(case, hook(SeedSystem(**common)))
    else:
        exact = hook(SymmetricSystem(**common))
        yield from _condensed(case, exact)
    yield from _energies(case, exact)
    yield from _constraint(case, exact)
    yield from _quadratic_model(case, exact)
    yield from _newton_system(case, exact, "exact", case.total.second, case.total.first)
    for number, solve in ((35, solve_kkt), (41, solve_reduced)):
        yield from _step(number, "Newton step, exact", case.newton, _solved(solve, exact))


# Sections 1.2 to 2.2: energies


def _energies(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    parts = case.kinetic.value + case.elastic.value - case.constraint.value
    yield Item(2, "energy E", _one(w.energy()), _one(case.total.value))
    for i, rows in zip(FIELDS, _split(case, w.gradient()), strict=True):
        yield Item(2, "∂E, zero where E is stationary", rows, case.total.first[i], i)
    yield Item(
        5, "E at x + δx, s + δs, λ + δλ", _one(w.moved(dx, ds, dl).energy()), _one(case.moved)
    )
    printed = w.E_M() + w.E_Psi() - w.E_Lambda()
    yield Item(6, "E_M + E_Ψ - E_Λ, summed by UFL", _one(printed), _one(parts))
    yield Item(7, "E_M", _one(w.E_M()), _one(case.kinetic.value))
    value, slope = case.first_iteration
    y = dx - np.ravel(H * case.velocity + H**2 * np.array(ACCELERATION))
    yield Item(8, "E_M at x^t + δx", _one(y @ (w.M @ y) / (2 * H**2)), _one(value))
    yield Item(9, "∂E_M/∂δx, first line, at x^t + δx", w.M @ y / H**2, slope)
    K = case.kinetic.second["xx"]
    yield Item(9, "g_x = M (x - x̃)/h²", w.g_x, case.kinetic.first["x"])
    yield Item(9, "M/h²", _dense(w.M) / H**2, K)
    g, K = case.elastic.first["s"], case.elastic.second["ss"]
    s = ds.reshape(w.s.shape)
    density = w.material.psi(w.s) + np.sum(w.g_K * s, axis=1)
    density = density + 0.5 * np.einsum("ni,nij,nj->n", s, w.H_K, s)
    model = case.elastic.value + g @ ds + 0.5 * ds @ K @ ds
    yield Item(10, "model of E_Ψ", _one(w.volume @ density), _one(model))
    slope_s = w.volume[:, None] * (w.g_K + np.einsum("nij,nj->ni", w.H_K, s))
    yield Item(11, "V_K (g_K + H_K δs_K)", slope_s.ravel(), g + K @ ds)


# Section 2.3: the constraint


def _rotation(case: Case, w: SeedSystem) -> Iterator[Item]:
    """(3), (4) and (14)-(17), cell by cell; UFL's integrals carry V_K."""
    V, n, kin = w.volume[:, None], len(w.W), case.kinematics
    yield Item(3, "vec(R_K S_K)", (V * np.einsum("nik,nk->ni", w.W, w.s)).ravel(), kin["RS"])
    vec_F = w.J @ w.state.x.ravel()
    yield Item(4, "J_K x", (V * vec_F.reshape(n, -1)).ravel(), kin["F"])
    yield Item(4, "J_K", _dense(w.J_w), kin["J"])
    yield Item(14, "R_K", (V * w.polar.R.reshape(n, -1)).ravel(), kin["R"])
    dR = block_diagonal(w.polar.dR.reshape(n, 9, 9)) @ w.J_w
    yield Item(15, "∂R_K/∂x, closed form", _dense(dR), kin["dR"])
    if case.names[3] != "rest":  # where σ are distinct
        (U, _, V_K), (dU, dV) = w.polar.svd, w.polar.svd_derivatives
        sum_15 = np.einsum("niakl,nja->nijkl", dU, V_K) + np.einsum("nia,njakl->nijkl", U, dV)
        dR = block_diagonal(sum_15.reshape(n, 9, 9)) @ w.J_w
        yield Item(15, "∂U Vᵀ + U ∂Vᵀ, distinct σ", _dense(dR), kin["dR"])
    yield Item(16, "W_K", _dense(block_diagonal(V[:, None] * w.W)), kin["W"])
    W_hat = [
        _dense(block_diagonal(np.swapaxes(w.W_hat[..., k], 1, 2)) @ w.J_w)
        for k in range(w.W_hat.shape[-1])
    ]
    yield Item(17, "Ŵ_K, times J_K", np.array(W_hat), kin["W_hat"])


def _constraint(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    """(12), (13) and (18)-(24), volume-weighted."""
    first, second = case.constraint.first, case.constraint.second
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    yield Item(12, "E_Λ", _one(w.E_Lambda()), _one(case.constraint.value))
    model: Any = w.E_Lambda() + dx @ w.E_x + ds @ w.E_s + dl @ w.c
    model -= dl @ (w.D @ ds) + dl @ (w.G @ dx) + ds @ (w.F @ dx) - 0.5 * dx @ (w.E_xx @ dx)
    expected: Any = case.constraint.value + sum(first[i] @ case.delta[i] for i in FIELDS)
    expected += sum(case.delta[i] @ second[i + j] @ case.delta[j] for i, j in ("ls", "lx", "sx"))
    expected += 0.5 * dx @ second["xx"] @ dx
    yield Item(13, "model of E_Λ", _one(model), _one(expected))
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
    yield Item(21, "∂²E_Λ/∂λ∂s", _dense(blocks[21]), second["ls"])
    yield Item(22, "∂²E_Λ/∂x∂λ", _dense(blocks[22]), second["xl"])
    yield Item(23, "∂²E_Λ/∂x∂s", _dense(blocks[23]), second["xs"])
    yield Item(24, "∂²E_Λ/∂x²", _dense(w.E_xx), second["xx"])


# Sections 3 and 4.1 to 4.3: the model of the energy and its derivatives


def _quadratic_model(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    new = w.lam + dl
    first, K = _printed_gradient(case), _printed_blocks(case)
    expected: Any = case.kinetic.value + case.elastic.value - case.constraint.value
    expected += sum(first[i] @ case.delta[i] for i in FIELDS)
    for i, j in ("ls", "lx", "sx"):
        expected += case.delta[i] @ K[i + j] @ case.delta[j]
    expected += 0.5 * ds @ K["ss"] @ ds + 0.5 * dx @ K["xx"] @ dx
    value = w.E_M() + w.E_Psi() + dx @ w.g_x + ds @ w.g_s - new @ w.c + ds @ (w.F @ dx)
    kinetic = 0.5 * dx @ (w.M @ dx) / H**2
    in_blocks = value + new @ (w.G @ dx + w.D @ ds) + 0.5 * ds @ (w.H @ ds) + kinetic
    yield Item(27, "model of E, in δx, δs, λ", _one(in_blocks), _one(expected))
    old: Any = w.E_M() + w.E_Psi() - w.E_Lambda()
    old += dx @ (w.g_x - w.E_x) + ds @ (w.g_s - w.E_s) - dl @ w.c
    old += dl @ (w.G @ dx + w.D @ ds) + ds @ (w.F @ dx) + 0.5 * ds @ (w.H @ ds) + kinetic
    yield Item(26, "model of E, before cancelling", _one(old), _one(expected))


def _cell_by_cell(case: Case, w: SeedSystem) -> Iterator[Item]:
    """(28)-(31) by the formulas of the seed; UFL's by differentiating its model."""
    V, n = w.volume[:, None], len(w.W)
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    s, x = ds.reshape(n, -1), (w.J @ dx).reshape(n, -1)
    new = (w.lam + dl).reshape(n, -1)
    bend = w.W_hat_s - np.eye(w.W_hat_s.shape[1])
    K = _printed_blocks(case)
    lam = w.lam + dl
    pull = np.einsum("njl,nl->nj", w.W_hat_lam, s) + np.einsum("njk,nk->nj", bend, new)
    eq_28 = w.M @ dx / H**2 + w.g_x - w.J_w.T @ pull.ravel()
    expected = K["xx"] @ dx + case.kinetic.first["x"] + K["xs"] @ ds + K["xl"] @ lam
    yield Item(28, "∂Ẽ/∂δx", eq_28, expected)
    pull = np.einsum("nij,ni->nj", w.W, new) + np.einsum("njl,nj->nl", w.W_hat_lam, x)
    eq_29 = w.g_K + np.einsum("nij,nj->ni", w.H_K, s) - pull
    g_s = case.elastic.first["s"]
    expected = g_s + K["ss"] @ ds + K["sl"] @ lam + K["sx"] @ dx
    yield Item(29, "V_K ∂Ẽ/∂δs", (V * eq_29).ravel(), expected)
    eq_30 = np.linalg.solve(w.H_K, (pull - w.g_K)[..., None]).ravel()
    yield Item(30, "δs of δx and λ", eq_30, _ds(case, K, dx, lam))
    eq_31 = -w.c_K - np.einsum("njk,nj->nk", bend, x) - np.einsum("nik,nk->ni", w.W, s)
    expected = -case.constraint.first["l"] + K["lx"] @ dx + K["ls"] @ ds
    yield Item(31, "V_K ∂Ẽ/∂λ", (V * eq_31).ravel(), expected)


# Section 4.4: the Newton system and its elimination


def _newton_system(
    case: Case, w: DiscreteSystem, name: str, K: Blocks, gradient: Blocks
) -> Iterator[Item]:
    """(32)-(41) against UFL's second and first derivatives."""
    dx, dl = case.delta["x"], case.delta["l"]
    lam = w.lam + dl
    for number, block, key in ((32, w.F, "sx"), (33, w.G, "lx"), (34, w.D, "ls")):
        # The term with ε, which is no part of (33), is in the blocks of the whole energy.
        expected = -case.constraint.second[key]
        yield Item(number, f"{'FGD'[number - 32]}", _dense(block), expected, name)

    matrix, rhs = w.kkt()
    expected_rhs = _right_hand_side(case, K, gradient)
    for key, block in _blocks(_dense(matrix), case, FIELDS).items():
        yield Item(35, f"matrix, {name}", block, K[key], key)
    for i, part in zip(FIELDS, _split(case, rhs), strict=True):
        yield Item(35, f"right-hand side, {name}", part, expected_rhs[i], i)

    ds = _ds(case, K, dx, lam)
    yield Item(36, f"δs of δx and λ, {name}", w.recover_ds(dx, lam), ds)
    reduced, reduced_rhs = w.reduced()
    left = np.split(reduced @ np.concatenate([dx, lam]) - reduced_rhs, [dx.size])
    for number, i, side in ((37, "x", left[0]), (38, "l", left[1])):
        expected = K[i + "x"] @ dx + K[i + "s"] @ ds + K[i + "l"] @ lam - expected_rhs[i]
        row = {"x": "first", "l": "third"}[i]
        yield Item(number, f"{row} row at any δx and λ, {name}", side, expected)

    g_s = case.elastic.first["s"]
    inverse = np.linalg.solve(K["ss"], np.column_stack([K["sx"], K["sl"], -g_s]))
    to_x, to_l, to_1 = np.split(inverse, [dx.size, dx.size + lam.size], axis=1)
    schur = {
        i + j: K[i + j] - K[i + "s"] @ column
        for i in "xl"
        for j, column in (("x", to_x), ("l", to_l))
    }
    yield Item(39, f"M̃, {name}", _dense(w.M_tilde), schur["xx"])
    yield Item(40, f"J̃, {name}", _dense(w.J_tilde), schur["lx"])
    for key, block in _blocks(_dense(reduced), case, "xl").items():
        yield Item(41, f"matrix, {name}", block, schur[key], key)
    for i, part in zip("xl", np.split(reduced_rhs, [dx.size]), strict=True):
        expected = expected_rhs[i] - (K[i + "s"] @ to_1).ravel()
        yield Item(41, f"right-hand side, {name}", part, expected, i)


def _condensed(case: Case, w: SymmetricSystem) -> Iterator[Item]:
    """The displacement-sized system against the Schur complement of UFL's blocks."""
    K, n = case.total.second, case.delta["x"].size
    b = _right_hand_side(case, K, case.total.first)
    local = np.block([[K["ss"], K["sl"]], [K["ls"], K["ll"]]])
    across = np.vstack([K["sx"], K["lx"]])
    column = np.column_stack([across, np.concatenate([b["s"], b["l"]])])
    solved = np.linalg.solve(local, column)
    matrix, rhs = w.condensed()
    expected = K["xx"] - across.T @ solved[:, :n]
    yield Item(CONDENSED, "condensed matrix, symmetric", _dense(matrix), expected)
    yield Item(CONDENSED, "its right-hand side", rhs, b["x"] - across.T @ solved[:, n])
    yield from _step(CONDENSED, "its Newton step", case.newton, _solved(solve_condensed, w))


def _step(number: int, what: str, expected: Blocks, step: Step) -> Iterator[Item]:
    """δx, δs and the new multiplier."""
    for part, i, own in (("δx", "x", step.dx), ("δs", "s", step.ds), ("λ", "l", step.lam)):
        yield Item(number, what, own, expected[i], part, STEP_TOLERANCE)


def _solved(solve: Callable[[Any], Step], w: DiscreteSystem) -> Step:
    """The step, or no numbers if the matrix is singular: that differs from any step."""
    try:
        return solve(w)
    except np.linalg.LinAlgError:
        return Step(*(np.full(size, np.nan) for size in (w.g_x.size, w.g_s.size, w.lam.size)))


def _printed_step(case: Case, w: SeedSystem) -> Iterator[Item]:
    """The singular system with (24) at a feasible state, on the range of the constraint.

    What it determines of the multiplier is the new sym(RᵀΛ) to first order, sym(RᵀΛ + δRᵀΛ^t).
    """
    R, dR = w.polar.R, w.polar.dR

    def seen(dx: Array, lam: Array) -> Array:
        dF = (w.J @ dx).reshape(R.shape)
        turned = np.einsum("nijkl,nkl->nij", dR, dF)
        product = np.swapaxes(R, 1, 2) @ lam.reshape(R.shape)
        product = product + np.swapaxes(turned, 1, 2) @ w.state.Lam
        return 0.5 * (product + np.swapaxes(product, 1, 2))

    expected = {**case.newton, "l": seen(case.newton["x"], case.newton["l"])}
    for number, solve in ((35, solve_kkt), (41, solve_reduced)):
        step = _solved(solve, w)
        step = replace(step, lam=seen(step.dx, step.lam))
        yield from _step(number, "Newton step, ε = 0, feasible states", expected, step)


# UFL's blocks of the Newton system


def _printed_blocks(case: Case) -> dict[str, Array]:
    """The blocks of (35) as printed, from UFL's derivatives of E_M, E_Ψ and E_Λ."""
    blocks = {key: -block for key, block in case.constraint.second.items()}
    return {**blocks, "xx": case.kinetic.second["xx"], "ss": case.elastic.second["ss"]}


def _right_hand_side(case: Case, K: Blocks, gradient: Blocks) -> dict[str, Array]:
    """Of the system for the new multiplier: K (0, 0, λ^t) - ∂E."""
    return {i: K[i + "l"] @ case.unknowns["l"] - gradient[i] for i in FIELDS}


def _ds(case: Case, K: Blocks, dx: Array, lam: Array) -> Array:
    """The second row solved for δs."""
    return np.linalg.solve(K["ss"], -case.elastic.first["s"] - K["sx"] @ dx - K["sl"] @ lam)


def _printed_gradient(case: Case) -> dict[str, Array]:
    """∂E of E_M + E_Ψ - E_Λ."""
    terms = case.kinetic.first, case.elastic.first, case.constraint.first
    return {i: terms[0][i] + terms[1][i] - terms[2][i] for i in FIELDS}


def _blocks(matrix: Array, case: Case, letters: str) -> dict[str, Array]:
    """The blocks of a matrix on some of the fields."""
    ends = np.cumsum([case.delta[i].size for i in letters])
    place = {i: slice(end - case.delta[i].size, end) for i, end in zip(letters, ends, strict=True)}
    return {i + j: matrix[place[i], place[j]] for i in letters for j in letters}


def _split(case: Case, vector: Array) -> list[Array]:
    sizes = [case.delta[i].size for i in FIELDS]
    return np.split(vector, np.cumsum(sizes)[:-1])


def _one(value: float | Array) -> Array:
    return np.array([value], dtype=float)


def _dense(matrix: sp.sparray) -> Array:
    dense: Array = matrix.toarray()
    return dense
