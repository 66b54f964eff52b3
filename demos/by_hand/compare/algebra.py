"""Newton's system out of UFL's derivatives, by dense algebra that knows nothing of the witness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from demos.by_hand.compare.assembly import FIELDS, Array
from demos.by_hand.compare.cases import Case

Blocks = Mapping[str, Array]
"""Matrices by the letters of row and column, or vectors by the letter of the row."""

NULL = 1e-10
"""Singular values this small beside the largest are zero."""


def printed_blocks(case: Case) -> dict[str, Array]:
    """The blocks of (35) as printed, from the derivatives of E_M, E_Ψ and E_Λ."""
    blocks = {key: -block for key, block in case.constraint.second.items()}
    return {**blocks, "xx": case.kinetic.second["xx"], "ss": case.elastic.second["ss"]}


def printed_gradient(case: Case) -> dict[str, Array]:
    """∂E of E_M + E_Ψ - E_Λ."""
    own = {**case.kinetic.first, **case.elastic.first}
    return {i: own.get(i, 0.0) - case.constraint.first[i] for i in FIELDS}


def model_energy(case: Case) -> float:
    """The model (26) of E_M + E_Ψ - E_Λ at the iterate plus `case.delta`."""
    first, K = printed_gradient(case), printed_blocks(case)
    value: Any = case.kinetic.value + case.elastic.value - case.constraint.value
    value += sum(first[i] @ case.delta[i] for i in FIELDS)
    for i, j in ("ls", "lx", "sx"):
        value += case.delta[i] @ K[i + j] @ case.delta[j]
    return float(value + sum(0.5 * case.delta[i] @ K[i + i] @ case.delta[i] for i in "sx"))


def with_cure(
    case: Case, eps: float, *, second: bool
) -> tuple[float, dict[str, Array], dict[str, Array]]:
    """The energy, the blocks of (35) and the gradient with any ε; UFL's energy is linear in it.

    Args:
        case: Of the seed's formulation.
        eps: ε, in units of the package's, 1/G₀.
        second: Whether ∂²E_Λ/∂x² is in the blocks.
    """
    value = case.kinetic.value + case.elastic.value - case.constraint.value
    blocks, gradient = printed_blocks(case), printed_gradient(case)
    complete = {**blocks, "xx": blocks["xx"] - case.constraint.second["xx"]}
    start, total = complete if second else blocks, case.total
    return (
        value + eps * (total.value - value),
        {key: start[key] + eps * (total.second[key] - complete[key]) for key in start},
        {i: gradient[i] + eps * (total.first[i] - gradient[i]) for i in FIELDS},
    )


def right_hand_side(case: Case, K: Blocks, gradient: Blocks) -> dict[str, Array]:
    """Of the system for the new multiplier: K (0, 0, λ^t) - ∂E."""
    return {i: K[i + "l"] @ case.unknowns["l"] - gradient[i] for i in FIELDS}


def stretch_step(case: Case, K: Blocks, dx: Array, lam: Array) -> Array:
    """The second row solved for δs."""
    return np.linalg.solve(K["ss"], -case.elastic.first["s"] - K["sx"] @ dx - K["sl"] @ lam)


def without_stretch(case: Case, K: Blocks, b: Blocks) -> tuple[dict[str, Array], dict[str, Array]]:
    """The matrix and the right-hand side that are left for x and λ once s is eliminated."""
    column = np.column_stack([K["sx"], K["sl"], b["s"]])
    nx = case.delta["x"].size
    to_x, to_l, to_1 = np.split(np.linalg.solve(K["ss"], column), [nx, column.shape[1] - 1], axis=1)
    matrix = {
        i + j: K[i + j] - K[i + "s"] @ solved
        for i in "xl"
        for j, solved in (("x", to_x), ("l", to_l))
    }
    return matrix, {i: b[i] - (K[i + "s"] @ to_1).ravel() for i in "xl"}


def solution(case: Case, K: Blocks, b: Blocks) -> dict[str, Array]:
    """The solution of the system, of a singular one that with the smallest λ."""
    _, sizes, directions = np.linalg.svd(np.vstack([K["xl"], K["sl"]]), full_matrices=False)
    seen = {"x": np.eye(case.delta["x"].size), "s": np.eye(case.delta["s"].size)}
    seen["l"] = np.eye(case.delta["l"].size)
    if not np.any(K["ll"]):
        kept = sizes > NULL * sizes[0]
        seen["l"] = directions[kept].T / sizes[kept]  # of one size in the system
    matrix = np.block([[seen[i].T @ K[i + j] @ seen[j] for j in FIELDS] for i in FIELDS])
    found = np.linalg.solve(matrix, np.concatenate([seen[i].T @ b[i] for i in FIELDS]))
    parts = np.split(found, np.cumsum([seen[i].shape[1] for i in "xs"]))
    return {i: seen[i] @ part for i, part in zip(FIELDS, parts, strict=True)}


def blocks_of(case: Case, matrix: Array, letters: str) -> dict[str, Array]:
    """The blocks of a matrix on some of the fields."""
    ends = np.cumsum([case.delta[i].size for i in letters])
    place = {i: slice(end - case.delta[i].size, end) for i, end in zip(letters, ends, strict=True)}
    return {i + j: matrix[place[i], place[j]] for i in letters for j in letters}


def parts_of(case: Case, vector: Array, letters: str = FIELDS) -> list[Array]:
    """The parts of a vector on some of the fields."""
    sizes = [case.delta[i].size for i in letters]
    return np.split(vector, np.cumsum(sizes)[:-1])
