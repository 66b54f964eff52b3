r"""Functions of a symmetric tensor, such as log S, that UFL can differentiate twice.

f(A) = Σ f(λᵢ) vᵢ vᵢᵀ is as smooth as f even where eigenvalues λᵢ coincide, which they do at rest,
but formulas in eigenvalues and eigenvectors are not. So, as in `forms.rotation`, a decomposition
A₀ = V diag(λ) Vᵀ cell by cell supplies numbers, and the UFL expression is the second-order Taylor
polynomial of f around A₀ (Daletskii and Krein): with D = Vᵀ A V - diag(λ)

    (Vᵀ f(A) V)ᵢⱼ = f[λᵢ] δᵢⱼ + f[λᵢ, λⱼ] Dᵢⱼ + Σₖ f[λᵢ, λₖ, λⱼ] Dᵢₖ Dₖⱼ + O(D³).

Divided differences f[·] are finite for equal arguments: f[λ, λ] = f'(λ), f[λ, λ, λ] = f''(λ)/2.
At A = A₀, where a solver evaluates the expression, its value and its first and second derivatives
are those of f(A).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import numpy.typing as npt
import ufl
from ufl.core.expr import Expr

from forms.cell_data import CellData, marked

Floats = npt.NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
# The same on the triangle 0 <= t₂ <= t₁ <= 1.
_T1 = np.repeat(_NODES, 6)
_T2 = _T1 * np.tile(_NODES, 6)
_AREAS = _T1 * np.outer(_WEIGHTS, _WEIGHTS).ravel()
# Gauss's rule with these nodes is exact to rounding up to this fraction of the radius; beyond,
# differences of f lose no more than two digits.
_NEAR = 0.25


@dataclass(frozen=True)
class ScalarFunction:
    """A smooth function of a real number, for `tensor_function`.

    Attributes:
        value: f.
        first: f'.
        second: f''.
        radius: Distance from which on f is no longer close to its Taylor polynomials, such as
            that to its nearest singularity.
        code: Its number in forms/code/spectral.h.
        exponent: That of a power.
    """

    value: Callable[[Floats], Floats]
    first: Callable[[Floats], Floats]
    second: Callable[[Floats], Floats]
    radius: Callable[[Floats], Floats]
    code: int
    exponent: float = 0.0


def traces_of_powers(A: Expr, exponents: Sequence[float]) -> Expr:
    """Return tr Aᵃ for each exponent a, with exact first and second UFL derivatives, shape (n,).

    For a material that is a function of such traces it is the same as `power`, at less cost.

    Args:
        A: Symmetric positive definite, shape (d, d).
        exponents: Real numbers.
    """
    return _TracesOfPowers.of(A, tuple(map(float, exponents))).function


def tensor_function(A: Expr, f: ScalarFunction) -> Expr:
    """Return f(A), with exact first and second UFL derivatives, shape (d, d).

    The expression holds per-cell data (`CellData`) that a solver refreshes. They are NaN where f
    is not defined at an eigenvalue of A.

    Args:
        A: Symmetric, shape (d, d).
        f: The function.
    """
    return _SpectralData.of(A, f).function


def log(A: Expr) -> Expr:
    """Return the logarithm of a symmetric positive definite tensor, see `tensor_function`."""
    return tensor_function(A, _LOG)


def exp(A: Expr) -> Expr:
    """Return the exponential of a symmetric tensor, see `tensor_function`."""
    return tensor_function(A, _EXP)


def power(A: Expr, exponent: float) -> Expr:
    """Return a real power of a symmetric positive definite tensor, see `tensor_function`."""
    return tensor_function(A, _power(float(exponent)))


@functools.cache
def _power(a: float) -> ScalarFunction:
    return ScalarFunction(
        lambda x: x**a,
        lambda x: a * x ** (a - 1.0),
        lambda x: a * (a - 1.0) * x ** (a - 2.0),
        radius=np.abs,
        code=_POWER,
        exponent=a,
    )


# Numbers of the functions in forms/code/spectral.h.
_LOGARITHM, _EXPONENTIAL, _POWER = 0, 1, 2

_LOG = ScalarFunction(
    np.log, lambda x: 1.0 / x, lambda x: -1.0 / x**2, radius=np.abs, code=_LOGARITHM
)
_EXP = ScalarFunction(np.exp, np.exp, np.exp, radius=np.ones_like, code=_EXPONENTIAL)


class _SpectralData(CellData):
    """V, λ and divided differences of orders 0, 1, 2 in one coefficient."""

    code = Path(__file__).parent / "code" / "spectral.h"
    symmetric = True

    def __init__(self, A: Expr, f: ScalarFunction) -> None:
        d = A.ufl_shape[0]
        self._f = f
        self._orders = [list(combinations_with_replacement(range(d), n)) for n in (1, 2, 3)]
        super().__init__(A, (d * d + d + sum(map(len, self._orders)),), "spectral")
        self.parameters = float(f.code), f.exponent
        self.rank, self.kept = d * (d + 1) // 2, 2 * d**2 + d**3 + d
        self.function = marked(self._expansion(), self)

    def compute(self, values: Floats) -> Floats:
        lam, V, lost = _decomposed(values)
        with np.errstate(all="ignore"):
            columns = [[lam[:, list(at)] for at in zip(*o, strict=True)] for o in self._orders]
            differences = np.concatenate(
                [divided_difference(self._f, *arguments) for arguments in columns], axis=1
            )
        differences[lost] = np.nan
        return np.concatenate([V.reshape(len(V), -1), lam, differences], axis=1)

    def _expansion(self) -> Expr:
        """The Taylor polynomial of f around the present A."""
        A = self.argument
        d = A.ufl_shape[0]
        V, D = _turned(A, self)
        numbers = {
            indices: self[d * d + d + k]
            for k, indices in enumerate(i for order in self._orders for i in order)
        }
        entries = [
            [
                (numbers[(i,)] if i == j else 0)
                + numbers[tuple(sorted((i, j)))] * D[i, j]
                + sum(numbers[tuple(sorted((i, k, j)))] * D[i, k] * D[k, j] for k in range(d))
                for j in range(d)
            ]
            for i in range(d)
        ]
        return V * ufl.as_matrix(entries) * V.T


class _TracesOfPowers(CellData):
    """V, λ, and of each power f its trace, f'(λ), f'[λᵢ, λⱼ]."""

    code = _SpectralData.code
    stem = "traces"
    symmetric = True

    def __init__(self, A: Expr, exponents: tuple[float, ...]) -> None:
        d = A.ufl_shape[0]
        self._exponents = exponents
        self._pairs = list(combinations_with_replacement(range(d), 2))
        each = d + len(self._pairs)
        super().__init__(A, (d * d + d + len(exponents) * (1 + each),), "traces")
        self.parameters = float(len(exponents)), *exponents
        self.rank, self.kept = len(self._pairs), d * d + d + len(exponents) * each
        self.function = marked(self._expansion(), self)

    def compute(self, values: Floats) -> Floats:
        lam, V, lost = _decomposed(values)
        columns = [V.reshape(len(V), -1), lam]
        with np.errstate(all="ignore"):
            for a in self._exponents:
                slope = _power(a - 1.0)
                differences = [
                    a * divided_difference(slope, lam[:, i], lam[:, j]) for i, j in self._pairs
                ]
                trace = np.sum(lam**a, axis=1)
                columns += [np.column_stack([trace, a * slope.value(lam), *differences])]
        for numbers in columns[2:]:
            numbers[lost] = np.nan
        return np.concatenate(columns, axis=1)

    def _expansion(self) -> Expr:
        """The Taylor polynomials around the present A."""
        d = self.argument.ufl_shape[0]
        each = 1 + d + len(self._pairs)
        _, D = _turned(self.argument, self)
        traces = []
        for first in range(d * d + d, self.ufl_shape[0], each):
            slopes = [self[first + 1 + i] * D[i, i] for i in range(d)]
            curved = [
                (1.0 if i < j else 0.5) * self[first + 1 + d + k] * D[i, j] ** 2
                for k, (i, j) in enumerate(self._pairs)
            ]
            traces.append(self[first] + sum(slopes) + sum(curved))
        return ufl.as_vector(traces)


def _decomposed(A: Floats) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Eigenvalues, ascending, and eigenvectors, by columns, and where there are none."""
    lost = ~np.isfinite(A).all(axis=(1, 2))
    lam, V = np.linalg.eigh(np.where(lost[:, None, None], np.eye(A.shape[1]), A))
    return lam, V, lost


def _turned(A: Expr, data: CellData) -> tuple[Expr, Expr]:
    """V, and D = Vᵀ A V - diag λ, V and λ being the first of the data."""
    d = A.ufl_shape[0]
    V = ufl.as_matrix([[data[d * i + j] for j in range(d)] for i in range(d)])
    return V, V.T * A * V - ufl.diag(ufl.as_vector([data[d * d + i] for i in range(d)]))


def divided_difference(f: ScalarFunction, *at: Floats) -> Floats:
    """Return f[a], f[a, b] or f[a, b, c], accurate for equal, close and distant arguments.

    Args:
        f: The function.
        at: One to three arrays of the same shape, ascending: a <= b <= c.
    """
    if len(at) == 1:
        return f.value(at[0])
    a, *_, c = at
    # Hermite and Genocchi: f[a, b] is the mean of f' from a to b, f[a, b, c] the integral of f''
    # over the triangle of the mixtures of a, b and c.
    if len(at) == 2:
        close = f.first(a[..., None] + np.multiply.outer(c - a, _NODES)) @ _WEIGHTS
    else:
        b = at[1]
        mixtures = np.multiply.outer(b - a, _T1) + np.multiply.outer(c - b, _T2)
        close = f.second(a[..., None] + mixtures) @ _AREAS
    near = c - a <= _NEAR * np.minimum(f.radius(a), f.radius(c))
    gap = np.where(near, 1.0, c - a)
    distant = (divided_difference(f, *at[1:]) - divided_difference(f, *at[:-1])) / gap
    result: Floats = np.where(near, close, distant)
    return result
