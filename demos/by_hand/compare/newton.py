"""Section 4.4: the Newton system, its elimination, and the steps that solve it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from demos.by_hand import (
    DiscreteSystem,
    SeedSystem,
    Step,
    SymmetricSystem,
    solve_condensed,
    solve_kkt,
    solve_printed,
    solve_reduced,
)
from demos.by_hand.compare.algebra import (
    Blocks,
    blocks_of,
    parts_of,
    printed_blocks,
    printed_gradient,
    right_hand_side,
    solution,
    stretch_step,
    with_cure,
    without_stretch,
)
from demos.by_hand.compare.assembly import FIELDS, Array
from demos.by_hand.compare.bodies import FEASIBLE
from demos.by_hand.compare.cases import Case
from demos.by_hand.compare.item import CONDENSED, Item, dense, one

STEP_TOLERANCE = 1e-9
"""Largest relative difference of a Newton step, solved by two linear solvers."""

PRINTED_TOLERANCE = 1e-7
"""The same as printed: some multipliers do 3e-6 of the work of others, which enlarges round-off."""


def newton_system(
    case: Case, w: DiscreteSystem, name: str, K: Blocks, gradient: Blocks
) -> Iterator[Item]:
    """(32)-(41) against UFL's second and first derivatives."""
    dx, dl = case.delta["x"], case.delta["l"]
    lam = w.lam + dl
    for number, block, key in ((32, w.F, "sx"), (33, w.G, "lx"), (34, w.D, "ls")):
        # The term with ε, which is no part of (33), is in the blocks of the whole energy.
        expected = -case.constraint.second[key]
        yield Item(number, f"{'FGD'[number - 32]}", dense(block), expected, name)

    matrix, rhs = w.kkt()
    expected_rhs = right_hand_side(case, K, gradient)
    for key, block in blocks_of(case, dense(matrix), FIELDS).items():
        yield Item(35, f"matrix, {name}", block, K[key], key)
    for i, part in zip(FIELDS, parts_of(case, rhs), strict=True):
        yield Item(35, f"right-hand side, {name}", part, expected_rhs[i], i)

    ds = stretch_step(case, K, dx, lam)
    yield Item(36, f"δs of δx and λ, {name}", w.recover_ds(dx, lam), ds)
    reduced, reduced_rhs = w.reduced()
    left = parts_of(case, reduced @ np.concatenate([dx, lam]) - reduced_rhs, "xl")
    for number, i, side in ((37, "x", left[0]), (38, "l", left[1])):
        expected = K[i + "x"] @ dx + K[i + "s"] @ ds + K[i + "l"] @ lam - expected_rhs[i]
        row = {"x": "first", "l": "third"}[i]
        yield Item(number, f"{row} row at any δx and λ, {name}", side, expected)

    schur, schur_rhs = without_stretch(case, K, expected_rhs)
    yield Item(39, f"M̃, {name}", dense(w.M_tilde), schur["xx"])
    yield Item(40, f"J̃, {name}", dense(w.J_tilde), schur["lx"])
    for key, block in blocks_of(case, dense(reduced), "xl").items():
        yield Item(41, f"matrix, {name}", block, schur[key], key)
    for i, part in zip("xl", parts_of(case, reduced_rhs, "xl"), strict=True):
        yield Item(41, f"right-hand side, {name}", part, schur_rhs[i], i)


def condensed(case: Case, w: SymmetricSystem) -> Iterator[Item]:
    """The displacement-sized system against the Schur complement of UFL's blocks."""
    K, n = case.total.second, case.delta["x"].size
    b = right_hand_side(case, K, case.total.first)
    local = np.block([[K["ss"], K["sl"]], [K["ls"], K["ll"]]])
    across = np.vstack([K["sx"], K["lx"]])
    column = np.column_stack([across, np.concatenate([b["s"], b["l"]])])
    solved = np.linalg.solve(local, column)
    matrix, rhs = w.condensed()
    expected = K["xx"] - across.T @ solved[:, :n]
    yield Item(CONDENSED, "condensed matrix, symmetric", dense(matrix), expected)
    yield Item(CONDENSED, "its right-hand side", rhs, b["x"] - across.T @ solved[:, n])
    yield from _step(CONDENSED, "its Newton step", case.newton, _solved(solve_condensed, w))


def _step(
    number: int, what: str, expected: Blocks, step: Step, tolerance: float = STEP_TOLERANCE
) -> Iterator[Item]:
    """δx, δs and the new multiplier."""
    for part, i, own in (("δx", "x", step.dx), ("δs", "s", step.ds), ("λ", "l", step.lam)):
        yield Item(number, what, own, expected[i], part, tolerance)


def _solved(solve: Callable[[Any], Step], w: DiscreteSystem) -> Step:
    """The step, or no numbers if the matrix is singular: that differs from any step."""
    try:
        return solve(w)
    except np.linalg.LinAlgError:
        return Step(*(np.full(size, np.nan) for size in (w.g_x.size, w.g_s.size, w.lam.size)))


def exact_steps(case: Case, w: DiscreteSystem) -> Iterator[Item]:
    """The step of the regular system against the one that the package's solver takes."""
    for number, solve in ((35, solve_kkt), (41, solve_reduced)):
        yield from _step(number, "Newton step, exact", case.newton, _solved(solve, w))


def another_eps(case: Case, w: SeedSystem, eps: float) -> Iterator[Item]:
    """The seed's system with an ε that is `eps` times the package's."""
    value, K, gradient = with_cure(case, eps, second=True)
    b = right_hand_side(case, K, gradient)
    yield Item(2, "energy E, another ε", one(w.energy()), one(value))
    for i, rows in zip(FIELDS, parts_of(case, w.gradient()), strict=True):
        yield Item(2, "∂E, another ε", rows, gradient[i], i)
    matrix, rhs = w.kkt()
    for key, block in blocks_of(case, dense(matrix), FIELDS).items():
        yield Item(35, "matrix, another ε", block, K[key], key)
    for i, part in zip(FIELDS, parts_of(case, rhs), strict=True):
        yield Item(35, "right-hand side, another ε", part, b[i], i)
    expected = solution(case, K, b)
    for number, solve in ((35, solve_kkt), (41, solve_reduced)):
        yield from _step(number, "Newton step, another ε", expected, _solved(solve, w))


def printed_steps(case: Case, printed: SeedSystem, complete: SeedSystem) -> Iterator[Item]:
    """The steps of the singular system, ε = 0.

    Args:
        case: UFL's side.
        printed: The system without ∂²E_Λ/∂x². Its step is that with the smallest λ, at infeasible
            states too.
        complete: The system with it. At a feasible state it takes the step of the regular one, but
            for the multiplier, of which it determines the new sym(RᵀΛ) to first order,
            sym(RᵀΛ + δRᵀΛ^t).
    """
    K = printed_blocks(case)
    expected = solution(case, K, right_hand_side(case, K, printed_gradient(case)))
    step = _solved(solve_printed, printed)
    yield from _step(35, "Newton step, as printed", expected, step, PRINTED_TOLERANCE)
    if case.names[3] not in FEASIBLE:
        return
    R, dR = complete.polar.R, complete.polar.dR

    def seen(dx: Array, lam: Array) -> Array:
        dF = (complete.J @ dx).reshape(R.shape)
        turned = np.einsum("nijkl,nkl->nij", dR, dF)
        product = np.swapaxes(R, 1, 2) @ lam.reshape(R.shape)
        product = product + np.swapaxes(turned, 1, 2) @ complete.state.Lam
        return 0.5 * (product + np.swapaxes(product, 1, 2))

    expected = {**case.newton, "l": seen(case.newton["x"], case.newton["l"])}
    for number, solve in ((35, solve_kkt), (41, solve_reduced)):
        step = _solved(solve, complete)
        step = replace(step, lam=seen(step.dx, step.lam))
        yield from _step(number, "Newton step, ε = 0, feasible states", expected, step)
