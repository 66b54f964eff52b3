"""The errata's texts, evaluated: print fails where they say so, and every sign and index counts."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from demos.by_hand import State, rotation
from demos.by_hand.errata import (
    ERRATA,
    EVALUATED,
    INDICES,
    READING,
    REMARKS,
    FormulaError,
    Letters,
    evaluate,
)
from tests.by_hand.systems import make_system, random_step, relative, split

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks

BY_NUMBER = {erratum.number: erratum for erratum in ERRATA}


def letters(one_cell, d=3):
    """Of a system with ε at a state where nothing vanishes, in a later Newton iteration."""
    w = make_system(d, "cured", second_derivatives=False)
    if one_cell:
        cell = w.state.cells[1]
        Lam, S = w.state.Lam[1:2], w.state.S[1:2]
        one = State(w.state.X[cell], np.arange(d + 1)[None], w.state.x[cell], S, Lam)
        w = dataclasses.replace(w, state=one, rho=1.2, v=w.v[cell], x_n=w.x_n[cell])
    return Letters(w, *split(w, random_step(w)))


def says(number, text, found):
    """What a text says, or None if nothing: it cannot be read, or contradicts itself."""
    try:
        first, *others = found.read(number, text)
    except FormulaError:
        return None
    consistent = all(a.shape == first.shape and relative(a, first) < 1e-9 for a in others)
    return first if consistent else None


def differs(a, b):
    return a is None or a.shape != b.shape or relative(a, b) > 1e-6


@pytest.mark.parametrize("d", [2, 3])
def test_what_is_printed_fails_where_the_errata_correct_it(d):
    """In what is left of them the two texts of a correction disagree; `compare` holds the other."""
    for number in EVALUATED:
        erratum, found = BY_NUMBER[number], letters(number in INDICES, d)
        true = says(number, erratum.true, found)
        assert true is not None, number
        assert np.linalg.norm(true) > 0.0, number
        if erratum.verdict == "corrected":
            assert differs(says(number, erratum.printed, found), true), number


def changes_of_a_sign(text):
    """The text with one sign changed, in any of its lines."""
    for place in re.finditer(r" [+-] |(?<=[(=] )-|(?<=\()-", text):
        sign = "-" if "+" in place[0] else "+"
        changed = place[0].replace("+", sign).replace("-", sign)
        if changed == "+":  # a leading minus
            changed = ""
        yield text[: place.start()] + changed + text[place.end() :]


def changes_of_an_index(text):
    """The text with one index of what is evaluated replaced by another of its line."""
    lines = text.splitlines()
    for n, line in enumerate(lines):
        middle = line.index(" = ")
        indices = [
            place.start() + k
            for place in re.finditer(r"_((?:[a-z]|\([a-z]+\))+)", line)
            for k, letter in enumerate(place[0])
            if letter.isalpha() and (place.start() > middle) != ("vec" in line)
        ]
        for at in indices:
            for other in sorted({line[k] for k in indices} - {line[at]}):
                changed = [*lines[:n], line[:at] + other + line[at + 1 :], *lines[n + 1 :]]
                yield "\n".join(changed)


@pytest.mark.parametrize("number", EVALUATED)
def test_a_change_of_a_sign_or_an_index_is_seen(number):
    """In the text of what is true: the value is another, or there is none."""
    text, found = BY_NUMBER[number].true, letters(number in INDICES)
    true = says(number, text, found)
    signs = list(changes_of_a_sign(text))
    assert len(signs) == len(re.findall(r" [+-] |[(=] ?-", text))
    changed = signs + (list(changes_of_an_index(text)) if number in INDICES else [])
    same = [t for t in changed if not differs(says(number, t, found), true)]
    if number == 26:  # a dilation turns no cell: ∂/∂x (∂c/∂s λ^t) does not see x^t
        assert np.linalg.norm(evaluate("F x^t", found.body)) < 1e-12
        assert "(x + x^t)ᵀ (∂/∂x (∂c/∂s λ^t))" in same.pop()
    assert same == []


def test_formulas_with_indices_are_sums_over_repeated_ones():
    rng = np.random.default_rng(0)
    A, b, T = rng.standard_normal((4, 3)), rng.standard_normal(3), rng.standard_normal((4, 9))
    symbols = {"A": A, "b": b, "T": T}
    np.testing.assert_allclose(evaluate("2 A_ij b_j", symbols, letters="i"), 2 * A @ b)
    np.testing.assert_allclose(
        evaluate("T_i(jk) b_j - A_ik", symbols, letters="ki"),
        (np.einsum("ijk,j->ik", T.reshape(4, 3, 3), b) - A).T,
    )
    by_definition = evaluate("(Q⁻¹)_ij b_j\nQ_ij = A_ki A_kj", symbols, letters="i")
    np.testing.assert_allclose(by_definition, np.linalg.solve(A.T @ A, b))


def test_formulas_with_matrices_are_products_of_columns_and_rows():
    rng = np.random.default_rng(0)
    A, b, M = rng.standard_normal((2, 3)), rng.standard_normal(3), np.diag([1.0, 2.0])
    symbols = {"A": A, "b": b, "M": M, "h": 0.1}
    cells = [{"V_K": 2.0}, {"V_K": 3.0}]
    np.testing.assert_allclose(evaluate("1/(2h²) A b", symbols), A @ b / 0.02)
    np.testing.assert_allclose(evaluate("‖A b‖²_M", symbols), A @ b @ M @ (A @ b))
    np.testing.assert_allclose(evaluate("b - Σ_{K∈T} b V_K", symbols, cells), -4.0 * b)
    blocks = evaluate("(M, A; Aᵀ, 0)", symbols)
    np.testing.assert_allclose(blocks, np.block([[M, A], [A.T, np.zeros((3, 3))]]))


@pytest.mark.parametrize(
    ("text", "letters", "message"),
    [
        ("A_ij c_j", "i", "no symbol is known at 'c_j'"),
        ("A_ij b_i", "j", "i runs to 3 and to 2"),
        ("A_ij b_j b_j", "i", "more than twice"),
        ("A_ij b_j", "j", "free indices are 'i', not 'j'"),
        ("A_i b_j", "i", "2 indices are wanted"),
        ("A bᵀ", "", "cannot be multiplied"),
        ("A + b", "", "cannot be added"),
        ("(A b", "", r"'\)' is missing"),
        ("A b )", "", "cannot read on"),
        ("(A, b; b, A)", "", "match|dimension"),
        ("A⁻¹ b", "", "square"),
    ],
)
def test_a_formula_that_means_nothing_says_why(text, letters, message):
    symbols = {"A": np.ones((2, 3)), "b": np.ones(3)}
    with pytest.raises(FormulaError, match=message):
        evaluate(text, symbols, letters=letters)


def test_equation_24_is_the_one_that_is_derived():
    """Its last lines name the quantities of the derivation, N, L and Ω."""
    assert "Ωᵀ N Ω - Ωᵀ L - Lᵀ Ω" in rotation.__doc__
    assert BY_NUMBER[24].corrected.count("\n") == 7


def test_remarks_concern_equations_and_answer():
    assert {number for remark in REMARKS for number in remark.equations} <= set(BY_NUMBER)
    assert all(remark.quote and len(remark.answer) > 100 for remark in REMARKS)
    assert len(READING) == 3
