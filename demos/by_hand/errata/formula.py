"""Formulas evaluated from their text, so that what the errata print is what is checked.

Two notations, as in the seed:

- With indices: in "J_ji Ŵ_jkl λ_k" an index that occurs twice in a product is summed, by plain
  loops. "(kl)" are the two indices of an axis that counts the entries of a matrix row by row.
- With matrices: in "Fᵀ H⁻¹ g_s^t" neighbours are multiplied, vectors being columns. A dot
  contracts: of Ŵ_K with λ_K the middle index, with s_K the last. "Σ_{K∈T}" sums the product that
  follows over the cells, ‖v‖²_M is vᵀ M v, and (a, b; c, d) is a matrix of blocks.

Symbols are looked up as they are printed, the longest that fits: "c(x^t, s^t)" or "g_{s_K}^t" are
symbols. Lines below a formula define symbols of it, the first of them by known ones alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache, reduce
from itertools import product
from typing import NamedTuple

import numpy as np

from demos.by_hand.basis import Array

Symbols = Mapping[str, Array | float]

NUMBERS: Symbols = {"½": 0.5, "0": 0.0, "1": 1.0, "2": 2.0}

ENDS = ("+", "-", ",", ";", ")", "‖²_M")
"""What a product ends before."""


class FormulaError(ValueError):
    """A formula that means nothing: an unknown symbol, or indices or sizes that do not fit."""


class Value(NamedTuple):
    """An array, and the letters of its axes if it has been given any."""

    array: Array
    letters: str = ""


def evaluate(
    text: str, symbols: Symbols, cells: Sequence[Symbols] = (), letters: str = ""
) -> Array:
    """Return the value of a formula.

    Args:
        text: The formula, without "=", and below it lines "name = formula", name with its indices
            if it has some.
        symbols: Values of the symbols.
        cells: Values of those that each cell has of its own, for "Σ_{K∈T}".
        letters: The free indices of the formula, in the order of the axes wanted.

    Raises:
        FormulaError: The formula cannot be read, or means nothing.
    """
    formula, *definitions = text.splitlines()
    known = {**NUMBERS, **symbols}
    for line in definitions:
        left, right = line.split(" = ")
        name, axes = re.fullmatch(r"\s*(.*?)(?:_([a-z]+))?", left).groups()  # type: ignore[union-attr]
        known[name.strip("()")] = _read(right, known, cells, axes or "")
    return _read(formula, known, cells, letters)


def sides(equation: str) -> list[str]:
    """The expressions between the signs "=" of an equation, each with the definitions below it."""
    line, *definitions = equation.splitlines()
    return ["\n".join([side, *definitions]) for side in line.split(" = ")]


def _read(text: str, symbols: Symbols, cells: Sequence[Symbols], letters: str) -> Array:
    reader = _Reader(text, symbols, cells)
    try:
        value = reader.sum()
        if reader.ahead():
            raise FormulaError(f"cannot read on from {reader.ahead()!r}")
        return _in_order(value, letters)
    except (FormulaError, np.linalg.LinAlgError) as error:
        raise FormulaError(f"{text}: {error}") from error


@cache
def _any_of(names: tuple[str, ...]) -> re.Pattern[str]:
    """What matches the longest name that comes next."""
    return re.compile("|".join(map(re.escape, sorted(names, key=len, reverse=True))))


class _Reader:
    """Evaluates as it reads."""

    def __init__(self, text: str, symbols: Symbols, cells: Sequence[Symbols], at: int = 0) -> None:
        self._text, self._symbols, self._cells, self._at = text, symbols, cells, at
        self._name = _any_of(tuple(symbols))

    def ahead(self) -> str:
        """What is still to be read."""
        return self._text[self._at :].lstrip()

    def _take(self, *tokens: str) -> str:
        """Step over the first of some tokens that comes next; return it, or nothing."""
        for token in tokens:
            if self.ahead().startswith(token):
                self._at = len(self._text) - len(self.ahead()) + len(token)
                return token
        return ""

    def _expect(self, token: str) -> None:
        if not self._take(token):
            raise FormulaError(f"{token!r} is missing before {self.ahead()!r}")

    def sum(self) -> Value:
        """A sum of products."""
        total, sign = None, self._take("-") or "+"
        while sign:
            term = self._product()
            if sign == "-":
                term = Value(-term.array, term.letters)
            total = term if total is None else _add(total, term)
            sign = self._take("+", "-")
        assert total is not None
        return total

    def _product(self) -> Value:
        if self._take("Σ_{K∈T}"):
            start, terms = self._at, []
            for cell in self._cells:
                inner = _Reader(self._text, {**self._symbols, **cell}, (), start)
                terms.append(inner._product())
                self._at = inner._at
            return reduce(_add, terms)
        factors = [self._factor()]
        while self.ahead() and not self.ahead().startswith(ENDS):
            if self._take("/"):
                factors.append(Value(1.0 / _number(self._factor())))
            elif self._take("·"):
                factors.append(_dot(factors.pop(), self._factor()))
            else:
                factors.append(self._factor())
        if any(factor.letters for factor in factors):
            return _sums(factors)
        return reduce(_times, factors)

    def _factor(self) -> Value:
        value = self._atom()
        while True:
            letters = re.match(r"_((?:[a-z]|\([a-z]+\))+)", self._text[self._at :])
            if letters:
                value = _label(value, letters[1])
                self._at += letters.end()
            elif self._take("^K"):  # says what the cell is, and nothing else
                continue
            elif self._take("ᵀ"):
                value = Value(_column(value).T)
            elif self._take("⁻¹"):
                value = Value(np.linalg.inv(value.array))
            elif self._take("²"):
                value = Value(_number(value) ** 2)
            else:
                return value

    def _atom(self) -> Value:
        if self._take("("):
            rows = [[self.sum()]]
            while mark := self._take(",", ";"):
                if mark == ";":
                    rows.append([])
                rows[-1].append(self.sum())
            self._expect(")")
            return rows[0][0] if len(rows) == len(rows[0]) == 1 else _blocks(rows)
        if self._take("‖"):
            v = _column(self.sum())
            self._expect("‖²_M")
            return Value((v.T @ self._symbols["M"] @ v)[0, 0])
        if name := self._name.match(self._text, len(self._text) - len(self.ahead())):
            self._at = name.end()
            return Value(np.asarray(self._symbols[name[0]], dtype=float))
        raise FormulaError(f"no symbol is known at {self.ahead()!r}")


def _label(value: Value, letters: str) -> Value:
    """Name the axes; "(kl)" splits one in two."""
    axes = re.findall(r"\([a-z]+\)|[a-z]", letters)
    if value.letters or len(axes) != value.array.ndim:
        raise FormulaError(f"{value.array.ndim} indices are wanted, not {letters!r}")
    shape: list[int] = []
    for axis, size in zip(axes, value.array.shape, strict=True):
        d = round(np.sqrt(size))
        if len(axis) > 1 and d * d != size:
            raise FormulaError(f"{axis} cannot count {size} entries")
        shape += [d, d] if len(axis) > 1 else [size]
    return Value(value.array.reshape(shape), re.sub(r"[()]", "", letters))


def _sums(factors: Sequence[Value]) -> Value:
    """The product of factors with indices, summed over those that occur twice."""
    if any(len(factor.letters) != factor.array.ndim for factor in factors):
        raise FormulaError("a factor has no indices, others have some")
    everywhere = "".join(factor.letters for factor in factors)
    if any(everywhere.count(letter) > 2 for letter in everywhere):
        raise FormulaError("an index occurs more than twice")
    free = {letter for letter in everywhere if everywhere.count(letter) == 1}
    result = Value(np.array(1.0))
    for k, factor in enumerate(factors):
        wanted = free.union(*(later.letters for later in factors[k + 1 :]))
        result = _loop(result, factor, wanted)
    return result


def _loop(a: Value, b: Value, wanted: set[str]) -> Value:
    """The sum over all indices but the wanted of the products of entries."""
    sizes: dict[str, int] = {}
    for value in (a, b):
        for letter, size in zip(value.letters, value.array.shape, strict=True):
            if sizes.setdefault(letter, size) != size:
                raise FormulaError(f"{letter} runs to {size} and to {sizes[letter]}")
    kept = "".join(letter for letter in sizes if letter in wanted)
    order = list(sizes)
    places = [[order.index(i) for i in letters] for letters in (a.letters, b.letters, kept)]
    result = np.zeros([sizes[letter] for letter in kept])
    for numbers in product(*map(range, sizes.values())):
        of_a, of_b, to = (tuple(numbers[k] for k in place) for place in places)
        result[to] += a.array[of_a] * b.array[of_b]
    return Value(result, kept)


def _in_order(value: Value, letters: str) -> Array:
    """The array with its axes in the order of the letters."""
    if sorted(value.letters) != sorted(letters):
        raise FormulaError(f"the free indices are {value.letters!r}, not {letters!r}")
    if not letters:
        return value.array.ravel() if value.array.shape[1:] == (1,) else value.array
    return value.array.transpose([value.letters.index(letter) for letter in letters])


def _add(a: Value, b: Value) -> Value:
    left = a.array if a.letters else _column(a)
    right = _in_order(b, a.letters) if a.letters else _column(b)
    if left.shape != right.shape or bool(a.letters) != bool(b.letters):
        raise FormulaError(f"sizes {left.shape} and {right.shape} cannot be added")
    return Value(left + right, a.letters)


def _times(a: Value, b: Value) -> Value:
    left, right = _column(a), _column(b)
    if left.ndim == 0 or right.ndim == 0:
        return Value(left * right)
    if left.ndim != 2 or right.ndim != 2 or left.shape[1] != right.shape[0]:
        raise FormulaError(f"sizes {left.shape} and {right.shape} cannot be multiplied")
    result = left @ right
    return Value(result[0, 0] if result.size == 1 else result)


def _dot(a: Value, b: Value) -> Value:
    """Two vectors, or Ŵ with λ over its middle index, with s over its last."""
    v = _column(b)[:, 0]
    if a.array.ndim < 3:
        return _times(Value(_column(a).T), b)
    axis = next((k for k in (1, 2) if a.array.shape[k] == v.size), None)
    if axis is None:
        raise FormulaError(f"sizes {a.array.shape} and {v.size} cannot be contracted")
    return Value(np.tensordot(a.array, v, (axis, 0)))


def _blocks(rows: Sequence[Sequence[Value]]) -> Value:
    """A matrix of blocks; a number in it, which can only be 0, takes the size that fits."""
    arrays = [[_column(value) for value in row] for row in rows]
    heights = [max(a.shape[0] for a in row if a.ndim) for row in arrays]
    widths = [max(a.shape[1] for a in column if a.ndim) for column in zip(*arrays, strict=True)]
    filled = [
        [a if a.ndim else np.full((height, width), a) for a, width in zip(row, widths, strict=True)]
        for row, height in zip(arrays, heights, strict=True)
    ]
    try:
        return Value(np.block(filled))
    except ValueError as error:
        raise FormulaError(str(error)) from error


def _column(value: Value) -> Array:
    return value.array[:, None] if value.array.ndim == 1 else value.array


def _number(value: Value) -> Array:
    if value.array.ndim:
        raise FormulaError(f"a number is wanted, not an array of size {value.array.shape}")
    return value.array
