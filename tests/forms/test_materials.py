"""Strain energies against formulas in principal stretches, finite differences and Hooke's law."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    MATERIALS,
    Corotational,
    Fung,
    MooneyRivlin,
    Ogden,
    deformation_gradient,
    displacement_field,
    mixed_fields,
    refresh,
    right_stretch,
)
from forms.spectral import exp, log, power, traces_of_powers
from tests.states import random_values, small_mesh

E, NU = 10.0, 0.3
LAWS = {name: kind(E, NU) for name, kind in MATERIALS.items()}
every_material = pytest.mark.parametrize("name", LAWS)
both_dimensions = pytest.mark.parametrize("d", [2, 3])


def stretches(d, n, rng):
    """Symmetric positive definite matrices, some with equal eigenvalues: shape (n, d, d)."""
    lam = rng.uniform(0.7, 1.5, (n, d))
    lam[0] = 1.0
    lam[1] = 1.3
    lam[2, 0] = lam[2, 1]
    lam[3, 0] = lam[3, 1] + 1e-9
    lam[4, 0] = lam[4, 1] + 1e-3
    V = np.linalg.qr(rng.standard_normal((n, d, d)))[0]
    return np.einsum("nik,nk,njk->nij", V, lam, V)


class Cells:
    """Values of expressions in DG0 symmetric tensors, set cell by cell."""

    def __init__(self, d):
        self.mesh = small_mesh(d)
        _, self.S, self.D1 = mixed_fields(self.mesh)
        self.D2 = self.D1.copy()
        self.lower = np.tril_indices(d)
        self.size = len(self.S.x.array) // len(self.lower[0])
        self.points = np.full((1, d), 1.0 / (d + 1))

    def put(self, f, values):
        f.x.array.reshape(self.size, -1)[:] = values[:, *self.lower]

    def compile(self, expression):
        """A function that evaluates the expression on all local cells, shape (cells, ...)."""
        compiled = fem.Expression(expression, self.points)
        cells = np.arange(self.size, dtype=np.int32)

        def evaluate():
            refresh([expression])
            return compiled.eval(self.mesh, cells)[:, 0]

        return evaluate


class Densities(Cells):
    """Ψ, ∂Ψ[D₁] and ∂²Ψ[D₁, D₂] of every material, on the cells of a mesh."""

    def __init__(self, d):
        super().__init__(d)
        entries = []
        for psi in LAWS.values():
            value = psi(self.S)
            first = ufl.derivative(value, self.S, self.D1)
            entries += [value, first, ufl.derivative(first, self.S, self.D2)]
        self.evaluate = self.compile(ufl.as_vector(entries))

    def at(self, name, S):
        """Three arrays of shape (cells,)."""
        self.put(self.S, S)
        k = 3 * list(LAWS).index(name)
        return self.evaluate()[:, k : k + 3].T


@pytest.fixture(scope="module", params=[2, 3])
def densities(request):
    return Densities(request.param)


def principal(name, lam):
    """Ψ of principal stretches, shape (n, 3), written independently."""
    psi = LAWS[name]
    mu, la, k = psi.mu, psi.lam, psi.lam + 2 * psi.mu / 3
    J, I1 = lam.prod(axis=1), (lam**2).sum(axis=1)
    e, G, H = lam - 1, (lam**2 - 1) / 2, np.log(lam)
    bar = lam / np.cbrt(J)[:, None]

    def hooke(strain):
        return mu * (strain**2).sum(axis=1) + la / 2 * strain.sum(axis=1) ** 2

    return {
        "as-rigid-as-possible": lambda: mu * (e**2).sum(axis=1),
        "corotational": lambda: hooke(e),
        "fixed-corotational": lambda: mu * (e**2).sum(axis=1) + la / 2 * (J - 1) ** 2,
        "stable-neo-hookean": lambda: mu / 2 * (I1 - 1 - 2 * J) + la / 2 * (J - 1) ** 2,
        "smith-neo-hookean": lambda: mu / 2 * (I1 - 1 - 2 * J) + (la + mu) / 2 * (J - 1) ** 2,
        "neo-hookean": lambda: mu / 2 * (I1 - 3) - mu * np.log(J) + la / 2 * np.log(J) ** 2,
        "st-venant-kirchhoff": lambda: hooke(G),
        "mooney-rivlin": lambda: (
            0.4 * mu * ((bar**2).sum(axis=1) - 3)
            + 0.1 * mu * ((bar**-2.0).sum(axis=1) - 3)
            + k / 2 * (J - 1) ** 2
        ),
        "ogden": lambda: (
            sum(
                2 * mu * w / a**2 * ((bar**a).sum(axis=1) - 3)
                for a, w in ((1.3, 8.19 / 8.45), (5.0, 0.06 / 8.45), (-2.0, 0.2 / 8.45))
            )
            + k / 2 * (J - 1) ** 2
        ),
        "hencky": lambda: hooke(H),
        "fung": lambda: mu / 2 * np.expm1(2 / mu * hooke(G)),
    }[name]()


@pytest.mark.serial
@every_material
def test_value_in_principal_stretches(densities, name):
    """In 2D with the third stretch equal to 1: plane strain."""
    d = densities.S.ufl_shape[0]
    S = stretches(d, densities.size, np.random.default_rng(1))
    lam = np.ones((len(S), 3))
    lam[:, :d] = np.linalg.eigvalsh(S)
    np.testing.assert_allclose(
        densities.at(name, S)[0], principal(name, lam), rtol=1e-11, atol=1e-13 * E
    )


@pytest.mark.serial
@every_material
def test_derivatives_against_finite_differences(densities, name):
    """First and second, by differences of order four, equal eigenvalues included."""
    d, rng = densities.S.ufl_shape[0], np.random.default_rng(2)
    S = stretches(d, densities.size, rng)
    D1, D2 = (stretches(d, densities.size, rng) - 0.9 * np.eye(d) for _ in range(2))
    densities.put(densities.D1, D1)
    densities.put(densities.D2, D2)
    _, first, second = densities.at(name, S)
    eps = 1e-3

    def difference(k, D):
        plus, minus, plus2, minus2 = (
            densities.at(name, S + step * eps * D)[k] for step in (1, -1, 2, -2)
        )
        return (8 * (plus - minus) - (plus2 - minus2)) / (12 * eps)

    np.testing.assert_allclose(difference(0, D1), first, rtol=1e-8, atol=1e-8 * E)
    np.testing.assert_allclose(difference(1, D2), second, rtol=1e-8, atol=1e-7 * E)
    assert np.abs(second).min() > 1e-3 * E


@pytest.mark.serial
@every_material
def test_rest(densities, name):
    """Ψ(I) = 0, no stress, and Hooke's law for what is small."""
    d, rng = densities.S.ufl_shape[0], np.random.default_rng(3)
    D1, D2 = (stretches(d, densities.size, rng) - 0.9 * np.eye(d) for _ in range(2))
    densities.put(densities.D1, D1)
    densities.put(densities.D2, D2)
    at_rest = np.tile(np.eye(d), (densities.size, 1, 1))
    value, first, second = densities.at(name, at_rest)
    assert np.abs(value).max() < 1e-14 * E
    assert np.abs(first).max() < 1e-14 * E
    mu, lam = LAWS[name].rest
    hooke = 2 * mu * np.einsum("nij,nij->n", D1, D2) + lam * np.trace(
        D1, axis1=1, axis2=2
    ) * np.trace(D2, axis1=1, axis2=2)
    np.testing.assert_allclose(second, hooke, rtol=0, atol=1e-13 * E)


def test_all_but_two_obey_hookes_law_of_E_and_nu():
    deviating = {name: psi.rest for name, psi in LAWS.items() if psi.rest != (psi.mu, psi.lam)}
    psi = Corotational(E, NU)
    assert deviating == {
        "as-rigid-as-possible": (psi.mu, 0.0),
        "stable-neo-hookean": (psi.mu, psi.lam - psi.mu),
    }


@both_dimensions
def test_objectivity(d):
    """Ψ(S(QF)) = Ψ(S(F)) for every material."""
    cells = Cells(d)
    u = displacement_field(cells.mesh)
    S = right_stretch(deformation_gradient(u))
    energies = cells.compile(ufl.as_vector([psi(S) for psi in LAWS.values()]))
    X = u.function_space.tabulate_dof_coordinates()[:, :d]
    x = X + 0.06 * random_values(u, 3).reshape(-1, d)
    u.x.array[:] = (x - X).ravel()
    before = energies()
    Q = np.linalg.qr(np.random.default_rng(4).standard_normal((d, d)))[0]
    Q[:, 0] *= np.linalg.det(Q)
    u.x.array[:] = (x @ Q.T - X).ravel()
    np.testing.assert_allclose(energies(), before, rtol=0, atol=1e-12 * E)
    assert MPI.COMM_WORLD.allreduce(before.max(initial=0.0), op=MPI.MAX) > 1e-2 * E


@pytest.mark.serial
@both_dimensions
def test_tensor_functions(d):
    """exp(log S) = S, and powers, whatever the spread of the eigenvalues."""
    cells = Cells(d)
    rng = np.random.default_rng(5)
    S = stretches(d, cells.size, rng)
    S[5:] = np.linalg.matrix_power(S[5:], 8)
    cells.put(cells.S, S)
    H = cells.compile(ufl.as_vector([log(cells.S), power(cells.S, -0.5), exp(cells.S)]))()
    lam, V = np.linalg.eigh(S)
    for k, f in enumerate((np.log, lambda x: x**-0.5, np.exp)):
        expected = np.einsum("nik,nk,njk->nij", V, f(lam), V)
        scale = np.maximum(np.abs(expected).max(axis=(1, 2)), 1.0)[:, None, None]
        np.testing.assert_allclose(H[:, k] / scale, expected / scale, rtol=0, atol=1e-12)
    exponents = (1.3, 5.0, -2.0)
    traces = cells.compile(traces_of_powers(cells.S, exponents))()
    expected = np.stack([np.sum(lam**a, axis=1) for a in exponents], axis=1)
    np.testing.assert_allclose(traces, expected, rtol=1e-11)


def test_undefined_is_nan_on_its_own_cell():
    """Where S is not positive definite Ψ is NaN, which a solver reports; elsewhere it is not."""
    densities = Densities(2)
    S = np.tile(np.eye(2), (densities.size, 1, 1))
    S[1] = -np.eye(2)
    undefined = np.isnan(densities.at("hencky", S)[0])
    np.testing.assert_array_equal(undefined, np.arange(densities.size) == 1)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Corotational(-1.0, 0.3), "E is -1.0"),
        (lambda: Corotational(float("nan"), 0.3), "E is nan"),
        (lambda: Fung(1.0, 0.5), "nu is 0.5"),
        (lambda: Fung(1.0, 0.3, b=0.0), "b is 0.0; the rate of stiffening must be positive"),
        (lambda: MooneyRivlin(1.0, 0.3, m=1.5), "m is 1.5; the second invariant's share must"),
        (lambda: Ogden(1.0, 0.3, (2.0,)), "there are 1 exponents and 3 weights"),
        (lambda: Ogden(1.0, 0.3, (2.0, 0.0), (0.5, 0.5)), "none may be 0 or infinite"),
        (lambda: Ogden(1.0, 0.3, (2.0, 1.0), (0.5, 0.6)), "must be positive, with sum 1"),
    ],
)
def test_parameters_out_of_range(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.serial
def test_one_term_ogden_is_neo_hookean():
    """α = 2 alone is Mooney-Rivlin without its second invariant."""
    cells = Cells(3)
    S = stretches(3, cells.size, np.random.default_rng(6))
    cells.put(cells.S, S)
    ogden, mooney = Ogden(E, NU, (2.0,), (1.0,)), MooneyRivlin(E, NU, m=0.0)
    values = cells.compile(ufl.as_vector([ogden(cells.S), mooney(cells.S)]))()
    np.testing.assert_allclose(values[:, 0], values[:, 1], rtol=1e-12, atol=1e-13 * E)


@pytest.mark.serial
@every_material
def test_str_is_the_formula(name):
    assert str(LAWS[name]).startswith("Ψ = ")
