"""The seed's equations evaluated from their text, against UFL.

The text is that of the errata, corrected where it needs to be, and the witness gives its letters
their values (`demos.by_hand.errata`). None of the code that combines them elsewhere takes part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from demos.by_hand import SeedSystem
from demos.by_hand.compare.algebra import (
    Blocks,
    model_energy,
    printed_blocks,
    printed_gradient,
    right_hand_side,
    stretch_step,
    with_cure,
    without_stretch,
)
from demos.by_hand.compare.assembly import FIELDS, Array
from demos.by_hand.compare.cases import Case
from demos.by_hand.compare.item import Item, one
from demos.by_hand.errata import ERRATA, FormulaError, Letters

PER_VOLUME = (16, *range(18, 25), 29, 31)
"""Equations per unit volume, where UFL's integrals are of a cell."""


def texts(case: Case, w: SeedSystem, eps: float) -> Iterator[Item]:
    """The equations whose text can be evaluated; those in index notation on a single cell.

    Args:
        case: UFL's side, of the seed's formulation.
        w: The system at the iterate, without ∂²E_Λ/∂x².
        eps: Its ε, in units of the package's.
    """
    increments = [case.delta[i] for i in FIELDS]
    moving, still = Letters(w, *increments), Letters(w, *(0.0 * step for step in increments))
    expected = {**_energies(case), **_model(case), **_system(case, eps)}
    if len(w.W) == 1:
        expected |= _derivatives(case)
    for number in sorted(expected):
        erratum = ERRATA[number - 1]
        what = f"its text, {'corrected' if erratum.corrected else 'as printed'}"
        letters = still if number == 12 else moving
        try:
            values = letters.read(number, erratum.true)
        except FormulaError:
            values = []
        fit = values and all(np.atleast_1d(v).shape == expected[number].shape for v in values)
        if not fit:  # a text that means nothing, or another thing, agrees with nothing
            values = [np.full_like(expected[number], np.nan)]
        volume = w.volume[:, None] if number in PER_VOLUME else 1.0
        for value in values:
            by_cell = value.reshape(len(w.W), -1) if number in PER_VOLUME else value
            weighted = np.reshape(volume * by_cell, expected[number].shape)
            yield Item(number, what, weighted, expected[number])


def _energies(case: Case) -> dict[int, Array]:
    """Of (7)-(13). E_M is quadratic, so that its derivatives give it everywhere."""
    dx, ds, _ = (case.delta[i] for i in FIELDS)
    E_M, E_Psi, E_Lam = case.kinetic, case.elastic, case.constraint
    moved = one(E_M.value + E_M.first["x"] @ dx + 0.5 * dx @ E_M.second["xx"] @ dx)
    g, H = E_Psi.first["s"], E_Psi.second["ss"]
    model: Any = sum(E_Lam.first[i] @ case.delta[i] for i in FIELDS)
    model += sum(case.delta[i] @ E_Lam.second[i + j] @ case.delta[j] for i, j in ("ls", "lx", "sx"))
    return {
        7: moved,
        8: moved,
        9: E_M.second["xx"] @ dx + E_M.first["x"],
        10: one(E_Psi.value + g @ ds + 0.5 * ds @ H @ ds),
        11: g + H @ ds,
        12: one(E_Lam.value),
        13: one(E_Lam.value + model + 0.5 * dx @ E_Lam.second["xx"] @ dx),
    }


def _derivatives(case: Case) -> dict[int, Array]:
    """Of (16)-(24), in indices."""
    first, second = case.constraint.first, case.constraint.second
    return {
        16: case.kinematics["RS"],
        18: first["x"],
        19: first["s"],
        20: first["l"],
        21: second["ls"],
        22: second["xl"],
        23: second["xs"],
        24: second["xx"],
    }


def _model(case: Case) -> dict[int, Array]:
    """Of (26)-(34): the model of the energy, its slope, and what that gives for δs."""
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    K, lam = printed_blocks(case), case.unknowns["l"] + dl
    model = one(model_energy(case))
    return {
        26: model,
        27: model,
        28: case.kinetic.first["x"] + K["xx"] @ dx + K["xs"] @ ds + K["xl"] @ lam,
        29: case.elastic.first["s"] + K["sx"] @ dx + K["ss"] @ ds + K["sl"] @ lam,
        30: stretch_step(case, K, dx, lam),
        31: -case.constraint.first["l"] + K["lx"] @ dx + K["ls"] @ ds,
        32: K["sx"],
        33: K["lx"],
        34: K["ls"],
    }


def _system(case: Case, eps: float) -> dict[int, Array]:
    """Of (35)-(41): what is left over of the equations at an increment that does not solve them."""
    dx, ds, dl = (case.delta[i] for i in FIELDS)
    lam = case.unknowns["l"] + dl
    K, gradient = printed_blocks(case), printed_gradient(case)
    b, best = right_hand_side(case, K, gradient), stretch_step(case, K, dx, lam)
    schur, _ = without_stretch(case, K, b)
    _, K_eps, gradient_eps = with_cure(case, eps, second=False)
    b_eps = right_hand_side(case, K_eps, gradient_eps)

    def left_over(K: Blocks, b: Blocks, ds: Array, rows: str) -> Array:
        over = [K[i + "x"] @ dx + K[i + "s"] @ ds + K[i + "l"] @ lam - b[i] for i in rows]
        return np.concatenate(over)

    return {
        35: left_over(K_eps, b_eps, ds, "xsl"),
        36: best,
        37: left_over(K, b, best, "x"),
        38: left_over(K, b, best, "l"),
        39: schur["xx"],
        40: schur["lx"],
        41: left_over(K_eps, b_eps, best, "xl"),
    }
