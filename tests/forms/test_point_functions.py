"""The C functions of a point alone, compiled by themselves: rotation, and functions of tensors."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cffi
import numpy as np
import pytest

import forms

pytestmark = pytest.mark.serial  # each rank would do the same

FOLDER = Path(forms.__file__).parent / "code"
CODE = """
#include <math.h>
#define DIM 3
#include "polar.h"
#include "spectral.h"
#define OF(NAME) \\
  void NAME(const double *p, const double *a, double *r, double *kept) \\
    { NAME##_value(p, a, r, kept, 0); } \\
  void NAME##_1(const double *p, const double *r, const double *kept, double *G, double *L) \\
    { NAME##_first(p, r, kept, G, L); } \\
  void NAME##_2(const double *p, const double *r, const double *kept, const double *n, \\
                double *C, double *E) { NAME##_second(p, r, kept, n, C, E); }
OF(polar)
OF(spectral)
OF(traces)
"""
DECLARATIONS = "".join(
    f"""
void {name}(const double *, const double *, double *, double *);
void {name}_1(const double *, const double *, const double *, double *, double *);
void {name}_2(const double *, const double *, const double *, const double *, double *, double *);
"""
    for name in ("polar", "spectral", "traces")
)

KEPT = 2 * 3**2 + 3**3 + 3  # of spectral.h


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("point")
    (folder / "point.c").write_text(CODE, "utf-8")
    command = ["cc", "-O1", "-shared", "-fPIC", f"-I{FOLDER}", "point.c", "-o", "point.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    ffi = cffi.FFI()
    ffi.cdef(DECLARATIONS)
    return ffi, ffi.dlopen(str(folder / "point.so"))


class Function:
    """A function of a point, with its derivatives put together from their factors."""

    def __init__(self, library, name, size, rank, kept, parameters=(0.0,), arguments=None):
        self._ffi, code = library
        self._value, self._first, self._second = (
            getattr(code, f"{name}{suffix}") for suffix in ("", "_1", "_2")
        )
        self.size, self.rank, self.arguments = size, rank, arguments or size
        self._kept, self._parameters = np.zeros(kept), np.array(parameters)

    def _call(self, function, *arrays):
        function(*(self._ffi.cast("double *", a.ctypes.data) for a in arrays))

    def value(self, a):
        """r(a)."""
        self.a, self.r = np.array(a, dtype=float).ravel(), np.full(self.size, np.nan)
        self._call(self._value, self._parameters, self.a, self.r, self._kept)
        return self.r

    def first(self, a):
        """∂r/∂a = G L, shape (size, arguments)."""
        self.value(a)
        G, L = np.empty((self.size, self.rank)), np.empty((self.rank, self.arguments))
        self._call(self._first, self._parameters, self.r, self._kept, G, L)
        self.L = L
        return G @ L

    def second(self, a, n):
        """∂²(n · r)/∂a² = Lᵀ C L + Eᵀ L + Lᵀ E, shape (arguments, arguments)."""
        self.first(a)
        C, E = np.empty((self.rank, self.rank)), np.empty((self.rank, self.arguments))
        self._call(self._second, self._parameters, self.r, self._kept, n, C, E)
        return self.L.T @ C @ self.L + E.T @ self.L + self.L.T @ E


def difference(f, a, direction, step):
    """The derivative along a direction by central differences of order four."""
    at = {k: f(a + k * step * direction) for k in (-2, -1, 1, 2)}
    return (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)


def check_derivatives(function, a, step, tolerance):
    """First and second derivatives at a, in two random directions, relative to their size."""
    rng = np.random.default_rng(5)
    n = rng.normal(size=function.size)
    J, H = function.first(a), function.second(a, n)
    for _ in range(2):
        d = rng.normal(size=function.arguments)
        d /= np.linalg.norm(d)
        wanted = difference(lambda x: function.value(x).copy(), a, d, step)
        np.testing.assert_allclose(J @ d, wanted, rtol=0, atol=tolerance * np.abs(J).max())
        wanted = difference(lambda x: n @ function.first(x), a, d, step)
        np.testing.assert_allclose(H @ d, wanted, rtol=0, atol=tolerance * np.abs(H).max())
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-13 * np.abs(H).max())


# The polar rotation


@pytest.fixture
def polar(library):
    return Function(library, "polar", 9, 3, 6)


def turned(sigma, seed=0):
    """U diag(σ) Vᵀ with rotations U and V, and U Vᵀ."""
    rng = np.random.default_rng(seed)
    U, V = np.linalg.qr(rng.normal(size=(2, 3, 3)))[0]
    U, V = (Q * np.linalg.det(Q) for Q in (U, V))
    return U @ np.diag(sigma) @ V.T, U @ V.T


# σ₁ >= σ₂ >= |σ₃|, the last with the sign of det F.
ROTATION_IS_SMOOTH = {
    "rest": (1.0, 1.0, 1.0),
    "moved": (1.3, 0.9, 0.4),
    "inverted": (1.3, 0.9, -0.4),
    "equal and inverted": (1.1, 1.1, -0.3),
    "flat": (1.3, 0.9, 0.0),
    "pressed": (1e-3, 9e-4, 8e-4),
    "stretched": (1e3, 1.1, 0.9),
    "stretched and inverted": (1e3, 1.1, -0.9),
}


@pytest.mark.parametrize("name", ROTATION_IS_SMOOTH)
def test_rotation(polar, name):
    """U Vᵀ, whatever the sign of det F, and its derivatives by differences."""
    sigma = ROTATION_IS_SMOOTH[name]
    F, R = turned(sigma)
    gap = sigma[1] + sigma[2]
    rounding = 1e-15 * sigma[0] / gap
    error = np.abs(polar.value(F).reshape(3, 3) - R).max()
    assert error < 30 * rounding
    check_derivatives(polar, F.ravel(), 3e-3 * gap, 1e-9 + 1e4 * rounding)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_rotation_where_two_singular_values_nearly_cancel(polar, gap):
    """Its derivative grows as 1/(σ₂ + σ₃), the second as the square of it."""
    F, R = turned((1.2, 0.8, gap - 0.8))
    np.testing.assert_allclose(polar.value(F).reshape(3, 3), R, rtol=0, atol=1e-14 / gap)
    assert np.linalg.norm(polar.first(F), 2) * gap == pytest.approx(2.0, rel=1e-6 + 1e-14 / gap)
    check_derivatives(polar, F.ravel(), 3e-3 * gap, 1e-9 + 1e-12 / gap)


DEGENERATE = {
    "nothing": (0.0, 0.0, 0.0),
    "rank 1": (1.3, 0.0, 0.0),
    "rank 2": (1.3, 0.7, 0.0),
    "cancelling": (1.2, 0.8, -0.8),
    "reflection": (1.0, 1.0, -1.0),
    "stretched to a line": (1e3, 0.0, 0.0),
    "stretched, cancelling": (1e3, 1.0, -1.0),
    "stretched, rank 2": (1e3, 1.0, 0.0),
    "nearly nothing": (1e-150, 1e-150, -1e-150),
}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", DEGENERATE)
def test_rotation_where_there_is_none(polar, name, seed):
    """One of those that turn F nearest to a symmetric tensor, and finite derivatives."""
    sigma = np.array(DEGENERATE[name])
    F, _ = turned(sigma, seed)
    R = polar.value(F).reshape(3, 3)
    np.testing.assert_allclose(R.T @ R, np.eye(3), rtol=0, atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    # Horn: the rotations that maximise tr RᵀF, the maximum being the sum of signed values.
    assert np.trace(R.T @ F) == pytest.approx(sigma.sum(), abs=1e-12 * max(1.0, sigma[0]))
    J, H = polar.first(F), polar.second(F, np.ones(9))
    assert np.isfinite(J).all() and np.isfinite(H).all()
    assert np.abs(J).max() < 1e9 and np.abs(H).max() < 1e18


def test_rotations_of_many(polar):
    """Drawn at random: of both signs of det F, against NumPy's singular values."""
    rng = np.random.default_rng(1)
    for F in rng.normal(size=(2000, 3, 3)) * 10.0 ** rng.uniform(-3, 3, (2000, 1, 1)):
        U, sigma, Vt = np.linalg.svd(F)
        sign = np.sign(np.linalg.det(U @ Vt))
        error = np.abs(polar.value(F).reshape(3, 3) - U @ np.diag([1, 1, sign]) @ Vt).max()
        assert error < 1e-14 * sigma[0] / (sigma[1] + sign * sigma[2])


# Functions of symmetric tensors, of which the lower triangle is the argument

LOWER = np.tril_indices(3)
FUNCTIONS = {
    "log": ((0.0, 0.0), np.log),
    "exp": ((1.0, 0.0), np.exp),
    "inverse": ((2.0, -1.0), lambda x: 1 / x),
    "root": ((2.0, 0.5), np.sqrt),
    "power 5": ((2.0, 5.0), lambda x: x**5),
}
EIGENVALUES = {
    "rest": (1.0, 1.0, 1.0),
    "two equal": (0.8, 0.8, 1.5),
    "nearly equal": (0.8, 0.8 + 1e-9, 1.5),
    "near": (0.8, 0.801, 0.803),
    "about where series end": (0.8, 1.02, 1.03),
    "beyond": (0.8, 1.03, 1.31),
    "distant": (0.05, 1.0, 6.0),
    "two equal, one distant": (4.0, 4.0, 0.05),
}


def largest(values):
    return np.abs(values).max()


def divided(name, a, b):
    """f[a, b] without cancellation."""
    _, exponent = FUNCTIONS[name][0]
    x = (a - b) / b
    if name == "exp":
        return np.exp(b) * (np.expm1(a - b) / (a - b) if a != b else 1.0)
    if name == "log":
        return (np.log1p(x) / x if x else 1.0) / b
    slope = np.expm1(exponent * np.log1p(x)) / x if x else exponent
    return b ** (exponent - 1) * slope


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_tensors(library, name, eigenvalues):
    """V f(λ) Vᵀ; the first derivative as Daletskii and Krein have it; the second by differences."""
    parameters, f = FUNCTIONS[name]
    function = Function(library, "spectral", 6, 6, KEPT, parameters)
    lam = np.array(EIGENVALUES[eigenvalues])
    V, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    A = (V * lam) @ V.T
    expected = (V * f(lam)) @ V.T
    first = np.array([[divided(name, a, b) for b in lam] for a in lam])
    rounding = 1e-14 * largest(first) * lam.max()
    np.testing.assert_allclose(function.value(A[LOWER]), expected[LOWER], rtol=0, atol=rounding)
    J = function.first(A[LOWER])
    for k, (i, j) in enumerate(zip(*LOWER, strict=True)):
        D = np.zeros((3, 3))
        D[i, j] = D[j, i] = 1.0
        change = V @ (first * (V.T @ D @ V)) @ V.T
        np.testing.assert_allclose(J[:, k], change[LOWER], rtol=0, atol=1e-13 * largest(first))
    check_derivatives(function, A[LOWER], 2e-3 * lam.min(), 1e-8)


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
def test_traces_of_powers(library, eigenvalues):
    """Σ λᵃ; the first derivative a Aᵃ⁻¹, the second as that of this function of A."""
    exponents = (1.3, 5.0, -2.0, 1.0)
    parameters = (4.0, *exponents)
    function = Function(library, "traces", 4, 6, 9 + 3 + 4 * 9, parameters, arguments=6)
    lam = np.array(EIGENVALUES[eigenvalues])
    V, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    A = ((V * lam) @ V.T)[LOWER]
    traces = [np.sum(lam**a) for a in exponents]
    np.testing.assert_allclose(function.value(A), traces, rtol=1e-13)
    twice = np.where(LOWER[0] == LOWER[1], 1.0, 2.0)  # an entry off the diagonal stands for two
    for k, a in enumerate(exponents):
        slope = ((V * (a * lam ** (a - 1.0))) @ V.T)[LOWER] * twice
        np.testing.assert_allclose(
            function.first(A)[k], slope, rtol=0, atol=1e-13 * largest(slope) * lam.max() / lam.min()
        )
        power = Function(library, "spectral", 6, 6, KEPT, (2.0, a - 1.0))
        curvature = a * twice[:, None] * power.first(A)
        np.testing.assert_allclose(
            function.second(A, np.eye(4)[k]), curvature, rtol=0, atol=1e-12 * largest(curvature)
        )
    check_derivatives(function, A, 2e-3 * lam.min(), 1e-8)


def test_functions_without_a_value(library):
    """NaN, for a solver to see, and nothing else."""
    for name in ("log", "root"):
        function = Function(library, "spectral", 6, 6, KEPT, FUNCTIONS[name][0])
        assert np.isnan(function.value(np.diag([1.0, -0.1, 2.0])[LOWER])).any()
