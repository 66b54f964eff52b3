"""Equation by equation: what is printed fails where the errata say so, the correction holds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

from demos.by_hand import ERRATA, Corotational, Polar, State, symmetric_basis
from tests.by_hand.systems import central, make_system, newton, random_step, relative, sizes, split

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks


def printed_or_corrected(numbers, verdict):
    assert all(ERRATA[number - 1].verdict == verdict for number in numbers)


def single_tetrahedron(**options):
    system = make_system(3, "seed", **options)
    state = system.state
    one = State(state.X[:4], np.arange(4)[None], state.x[:4], state.S[:1], state.Lam[:1])
    return dataclasses.replace(
        system, state=one, rho=1.2, v=system.v[:4], x_n=system.x_n[:4], second_derivatives=False
    )


def test_errata_cover_every_number_once():
    assert [erratum.number for erratum in ERRATA] == list(range(1, 42))
    for erratum in ERRATA:
        assert bool(erratum.corrected) == (erratum.verdict == "corrected")
        assert erratum.verdict == "holds as printed" or erratum.reason


def test_2_the_energy_has_no_minimum():
    """It falls without bound along λ = t c; the Hessian has eigenvalues of both signs."""
    printed_or_corrected([2], "corrected")
    system = make_system(3, "seed")
    rate = system.c @ system.c_K.ravel()
    assert rate > 0.1
    for t in (1e3, 1e6):
        moved = system.moved(0 * system.g_x, 0 * system.g_s, t * system.c_K.ravel())
        assert moved.energy() - system.energy() == pytest.approx(-t * rate, rel=1e-9)
    solved, _ = newton(make_system(3, "cured", "feasible", Corotational(1.0, 1.0), h=0.1), None, 12)
    assert np.linalg.norm(solved.gradient()) < 1e-9
    eigenvalues = np.linalg.eigvalsh(solved.kkt()[0].toarray())
    assert eigenvalues[0] < 0.0 < eigenvalues[-1]


def test_3_4_and_12_by_definition():
    printed_or_corrected([3, 4, 12, 16, 20, 21], "holds as printed")
    system = make_system(3, "seed")
    state, R = system.state, system.polar.R
    total = 0.0
    for K, cell in enumerate(state.cells):
        F = np.linalg.solve(
            state.X[cell[1:]] - state.X[cell[0]], state.x[cell[1:]] - state.x[cell[0]]
        ).T
        RS = R[K] @ state.S[K]
        np.testing.assert_allclose(system.W[K] @ system.s[K], RS.ravel(), atol=1e-13)
        np.testing.assert_allclose(system.J_K[K] @ state.x[cell].ravel(), F.ravel(), atol=1e-13)
        np.testing.assert_allclose(system.c_K[K], (RS - F).ravel(), atol=1e-13)
        total += np.sum(state.Lam[K] * (RS - F)) * system.volume[K]
    assert system.E_Lambda() == pytest.approx(total, rel=1e-13)


def test_5_to_8_kinetic_energy():
    """(8) equals (7) if the iterate is the start of the step, and only then."""
    printed_or_corrected([5, 6, 7], "holds as printed")
    printed_or_corrected([8], "corrected")
    for later in (False, True):
        system = make_system(3, "seed")
        if not later:
            system = dataclasses.replace(system, x_n=None)
        dx, ds, dlam = split(system, random_step(system))
        moved = system.moved(dx, ds, dlam)
        increment = dx.reshape(-1, 3) - system.h * system.v - system.h**2 * system.f_ext
        eq_8 = increment.ravel() @ (system.M @ increment.ravel()) / (2 * system.h**2)
        assert (moved.E_M() == pytest.approx(eq_8, rel=1e-12)) is not later
        assert moved.energy() == moved.E_M() + moved.E_Psi() - moved.E_Lambda()


def test_9_the_gradient_of_the_kinetic_energy():
    printed_or_corrected([9], "corrected")
    system = dataclasses.replace(make_system(3, "seed"), x_n=None)
    dx = split(system, random_step(system))[0]
    zeros = [np.zeros(size) for size in sizes(system)[1:]]
    direction = np.random.default_rng(3).standard_normal(dx.size)
    slope = central(lambda t: system.moved(dx + t, *zeros).E_M(), direction, 1e-3)
    g_x = np.ravel(system.h * system.v + system.h**2 * system.f_ext)
    first_line = system.M @ (dx - g_x) / system.h**2
    assert direction @ first_line == pytest.approx(slope, rel=1e-9)
    assert direction @ (system.M @ dx / system.h**2 + system.g_x) == pytest.approx(slope, rel=1e-9)
    # The same letter in (27)-(41), with the value of (9), is no gradient.
    assert direction @ (system.M @ dx / system.h**2 + g_x) != pytest.approx(slope, rel=1e-2)


def remainder_order(exact, model, vector):
    """Observed order of exact - model under scaling of the increment."""
    errors = [abs(exact(t * vector) - model(t * vector)) for t in (2e-2, 1e-2)]
    return np.log2(errors[0] / errors[1])


def test_10_and_11_quadratic_model_of_the_elastic_energy():
    printed_or_corrected([10], "holds as printed")
    printed_or_corrected([11], "corrected")
    system = make_system(3, "seed")
    still = np.zeros(system.g_x.size), np.zeros(system.lam.size)

    def model(ds):
        ds = ds.reshape(system.s.shape)
        density = system.material.psi(system.s) + np.sum(ds * system.g_K, axis=1)
        density += 0.5 * np.einsum("ni,nij,nj->n", ds, system.H_K, ds)
        return density @ system.volume

    def exact(ds):
        return system.moved(still[0], ds, still[1]).E_Psi()

    ds = np.random.default_rng(3).standard_normal(system.s.size)
    assert remainder_order(exact, model, ds) == pytest.approx(3.0, abs=0.1)
    terms = (system.g_K + np.einsum("nij,nj->ni", system.H_K, ds.reshape(system.s.shape))) * (
        system.volume[:, None]
    )
    K = 2
    for k in range(6):
        unit = np.zeros_like(system.s)
        unit[K, k] = 1.0
        slope = central(lambda t: model(ds + t.ravel()), unit, 1e-3)
        assert terms[K, k] == pytest.approx(slope, rel=1e-8)
        assert terms.sum(axis=0)[k] != pytest.approx(slope, rel=1e-2)


def test_13_quadratic_model_of_the_constraint_energy():
    printed_or_corrected([13], "holds as printed")
    system = make_system(3, "seed")

    def model(step):
        dx, ds, dlam = split(system, step)
        lam = dlam.reshape(len(system.W), -1)
        s, x = ds.reshape(system.s.shape), (system.J @ dx).reshape(lam.shape)
        G_K = system.W_hat_s - np.eye(9)  # (22) before J
        old = system.lam.reshape(lam.shape)
        density = np.einsum("nj,njk,nk->n", x, G_K, old)
        density += np.einsum("nl,nkl,nk->n", s, system.W, old)
        density += np.einsum("nk,nk->n", lam, system.c_K)
        density += np.einsum("nk,nkl,nl->n", lam, system.W, s)
        density += np.einsum("nj,njk,nk->n", x, G_K, lam)
        density += np.einsum("nj,njl,nl->n", x, system.W_hat_lam, s)
        density += 0.5 * np.einsum("np,npq,nq->n", x, system.E_FF, x)
        return system.E_Lambda() + density @ system.volume

    def exact(step):
        return system.moved(*split(system, step)).E_Lambda()

    assert remainder_order(exact, model, random_step(system)) == pytest.approx(3.0, abs=0.2)


def test_17_index_order_of_W_hat():
    """F's index first; the numerator's first fails in (18)."""
    printed_or_corrected([17], "corrected")
    system = single_tetrahedron()
    F = system.deformation_gradient
    for j, unit in enumerate(np.eye(9)):
        direction = unit.reshape(1, 3, 3)
        dR = central(lambda dF: Polar(F + dF).R, direction, 1e-5)
        expected = np.einsum("im,kmj->ijk", dR[0], symmetric_basis(3)).reshape(9, 6)
        np.testing.assert_allclose(system.W_hat[0, j], expected, atol=1e-8)
    transposed = system.with_blocks(W_hat=np.swapaxes(system.W_hat, 1, 2))
    still = [np.zeros(size) for size in sizes(system)[1:]]
    direction = np.random.default_rng(1).standard_normal(system.g_x.size)
    slope = central(lambda t: system.moved(t, *still).E_Lambda(), direction, 1e-5)
    assert direction @ system.E_x == pytest.approx(slope, rel=1e-7)
    assert direction @ transposed.E_x != pytest.approx(slope, rel=1e-2)


def test_18_19_22_23_need_transposes():
    """As printed their indices do not even fit: J_K is 9×12 and W_K 9×6 on one tetrahedron."""
    printed_or_corrected([18, 19, 22, 23], "corrected")
    system = single_tetrahedron()
    J, W, W_hat, s = system.J.toarray(), system.W[0], system.W_hat[0], system.s[0]
    lam, V = system.lam, system.volume[0]
    inner = np.einsum("jkl,l->jk", W_hat, s) - np.eye(9)
    for printed in (
        lambda: np.einsum("ij,jk,k->i", J, inner, lam),
        lambda: np.einsum("ij,j->i", W, lam),
        lambda: np.einsum("ij,jk->ik", J, inner),
        lambda: np.einsum("ij,jkl,k->il", J, W_hat, lam),
    ):
        with pytest.raises(ValueError):
            printed()

    def slopes(f, part):
        """∂f/∂(x, s, λ)[part] times 1/V_K, by central differences."""
        rows = []
        for unit in np.eye(sizes(system)[part]):
            steps = [np.zeros(size) for size in sizes(system)]

            def at(t, steps=steps):
                return f(system.moved(*[t if i == part else z for i, z in enumerate(steps)]))

            rows.append(central(at, unit, 1e-5) / V)
        return np.array(rows)

    x, S, L = range(3)
    close = {"rtol": 1e-7, "atol": 1e-8}
    E = slopes(lambda moved: moved.E_Lambda(), x)
    np.testing.assert_allclose(np.einsum("ji,jk,k->i", J, inner, lam), E, **close)
    E = slopes(lambda moved: moved.E_Lambda(), S)
    np.testing.assert_allclose(np.einsum("ji,j->i", W, lam), E, **close)
    E = slopes(lambda moved: moved.E_Lambda(), L)
    np.testing.assert_allclose(W @ s - J @ system.state.x.ravel(), E, **close)  # (20)
    E = slopes(lambda moved: moved.c, x)
    np.testing.assert_allclose(np.einsum("ji,jk->ik", J, inner), E, **close)
    E = slopes(lambda moved: moved.c, S)
    np.testing.assert_allclose(W.T, E, **close)  # (21)
    E = slopes(lambda moved: moved.E_s, x)
    np.testing.assert_allclose(np.einsum("ji,jkl,k->il", J, W_hat, lam), E, **close)
    E = slopes(lambda moved: moved.E_x, x)
    np.testing.assert_allclose(J.T @ system.E_FF[0] @ J, E, **close)  # (24)


def quadratic_model(system, step, g_x=None):
    """Eqs. (26)-(27): the energy's model without ∂²E_Λ/∂x²."""
    dx, ds, dlam = split(system, step)
    lam = system.lam + dlam
    return (
        system.E_M()
        + system.E_Psi()
        + dx @ (system.g_x if g_x is None else g_x)
        + ds @ system.g_s
        - lam @ system.c
        + dx @ (system.F.T @ ds)
        + lam @ (system.G @ dx + system.D @ ds)
        + 0.5 * ds @ (system.H @ ds)
        + 0.5 * dx @ (system.M @ dx) / system.h**2
    )


def test_26_and_27_quadratic_model_of_the_energy():
    """Second-order remainder without ∂²c/∂x², third-order with it; g_x of (9) fails."""
    printed_or_corrected([26, 27], "holds as printed")
    system = dataclasses.replace(make_system(3, "seed"), x_n=None)
    step = random_step(system)

    def exact(step):
        return system.moved(*split(system, step)).energy()

    def complete(step):
        dx = split(system, step)[0]
        return quadratic_model(system, step) - 0.5 * dx @ (system.E_xx @ dx)

    def with_g_of_9(step):
        g = np.ravel(system.h * system.v + system.h**2 * system.f_ext)
        return quadratic_model(system, step, g)

    assert remainder_order(exact, complete, step) == pytest.approx(3.0, abs=0.2)
    order = remainder_order(exact, lambda t: quadratic_model(system, t), step)
    assert order == pytest.approx(2.0, abs=0.2)
    assert remainder_order(exact, with_g_of_9, step) == pytest.approx(1.0, abs=0.2)


def test_28_to_34_derivatives_of_the_model_cell_by_cell():
    """Loops over cells as printed against differences of the model (27) and the global blocks."""
    printed_or_corrected([28, 29, 32, 33], "holds as printed")
    printed_or_corrected([30, 31, 34], "corrected")
    system = make_system(3, "seed", second_derivatives=False)
    step = random_step(system)
    dx, ds, dlam = split(system, step)
    new = (system.lam + dlam).reshape(-1, 9)
    slope = np.array(
        [central(lambda t: quadratic_model(system, step + t), e, 1.0) for e in np.eye(step.size)]
    )
    slope_x, slope_s, slope_lam = split(system, slope)
    eq_28 = system.M @ dx / system.h**2 + system.g_x
    n = len(system.W)
    F, G, D = (
        np.zeros((rows, columns))
        for rows, columns in ((6 * n, dx.size), (9 * n, dx.size), (9 * n, 6 * n))
    )
    for K in range(n):
        J = system.J[9 * K : 9 * K + 9].toarray()
        W, V = system.W[K], system.volume[K]
        W_lam = np.einsum("jkl,k->jl", system.W_hat[K], system.lam[9 * K : 9 * K + 9])
        W_s = np.einsum("jkl,l->jk", system.W_hat[K], system.s[K])
        s = ds[6 * K : 6 * K + 6]
        eq_28 -= (J.T @ (W_lam @ s) + J.T @ ((W_s - np.eye(9)) @ new[K])) * V
        eq_29 = system.g_K[K] + system.H_K[K] @ s - W.T @ new[K] - W_lam.T @ (J @ dx)
        np.testing.assert_allclose(eq_29 * V, slope_s[6 * K : 6 * K + 6], atol=1e-9)
        eq_30 = np.linalg.solve(system.H_K[K], W.T @ new[K] + W_lam.T @ (J @ dx) - system.g_K[K])
        np.testing.assert_allclose(
            system.g_K[K] + system.H_K[K] @ eq_30 - W.T @ new[K], W_lam.T @ (J @ dx), atol=1e-9
        )
        np.testing.assert_allclose(
            eq_30, system.recover_ds(dx, new.ravel())[6 * K : 6 * K + 6], atol=1e-9
        )
        eq_31 = -system.c_K[K] - (W_s - np.eye(9)).T @ (J @ dx) - W @ s
        np.testing.assert_allclose(eq_31 * V, slope_lam[9 * K : 9 * K + 9], atol=1e-9)
        F[6 * K : 6 * K + 6] -= W_lam.T @ (V * J)
        G[9 * K : 9 * K + 9] += V * J - W_s.T @ (V * J)
        D[9 * K : 9 * K + 9, 6 * K : 6 * K + 6] -= W
    np.testing.assert_allclose(eq_28, slope_x, atol=1e-9)
    assert relative(system.F, F) < 1e-13
    assert relative(system.G, G) < 1e-13
    # (34): ∂²E/∂λ∂s has the volume
    mixed = np.array(
        [
            central(lambda t: system.moved(0 * dx, t, 0 * dlam).gradient()[-dlam.size :], e, 1.0)
            for e in np.eye(ds.size)
        ]
    ).T
    assert relative(np.repeat(system.volume, 9)[:, None] * D, mixed) < 1e-11
    assert relative(D, mixed) > 0.5
    assert relative(system.D, mixed) < 1e-11


@pytest.mark.parametrize("kind", ["feasible", "infeasible"])
def test_35_needs_volumes(kind):
    """With (34) as printed, or unweighted H, g_s or c, its solution is no stationary point."""
    printed_or_corrected([35], "corrected")
    system = make_system(3, "seed", kind, second_derivatives=False)
    V = system.volume

    def residual(blocks):
        """Slope of the model (27) at the solution of (35), relative to that at no step."""
        matrix, rhs = system.with_blocks(**blocks).kkt()
        solution = np.linalg.lstsq(matrix.toarray(), rhs, rcond=1e-12)[0]
        solution[-system.lam.size :] -= system.lam
        slope = np.array(
            [
                central(lambda t: quadratic_model(system, solution + t), e, 1.0)
                for e in np.eye(solution.size)
            ]
        )
        return np.linalg.norm(slope) / np.linalg.norm(system.gradient())

    assert residual({}) < 1e-9
    unweighted = {
        "D": -sp.csr_array(scipy.linalg.block_diag(*system.W)),
        "H": sp.csr_array(scipy.linalg.block_diag(*system.H_K)),
        "g_s": system.g_K.ravel(),
    }
    if kind == "infeasible":  # c = 0 otherwise
        unweighted["c"] = system.c_K.ravel()
    assert np.ptp(V) > 1e-3
    for name, block in unweighted.items():
        assert residual({name: block}) > 1e-2, name


def test_36_to_41_elimination():
    """Any (δx, λ) with δs by (36) gives the same rows in (35), in (37)-(38) and in (41)."""
    printed_or_corrected([36, 37, 38, 39, 40], "holds as printed")
    printed_or_corrected([41], "corrected")
    system = make_system(3, "seed", second_derivatives=False)
    dx, _, lam = split(system, random_step(system))
    H_inv = np.linalg.inv(system.H.toarray())
    F, G, D = system.F.toarray(), system.G.toarray(), system.D.toarray()
    ds = H_inv @ (-system.g_s - D.T @ lam - F @ dx)
    matrix, rhs = system.kkt()
    rows = split(system, matrix @ np.concatenate([dx, ds, lam]) - rhs)
    np.testing.assert_allclose(rows[1], 0.0, atol=1e-11)
    M = system.M.toarray() / system.h**2
    eq_37 = (M - F.T @ H_inv @ F) @ dx + (G.T - F.T @ H_inv @ D.T) @ lam
    eq_37 -= F.T @ H_inv @ system.g_s - system.g_x
    eq_38 = (G - D @ H_inv @ F) @ dx - D @ H_inv @ D.T @ lam - system.c - D @ H_inv @ system.g_s
    np.testing.assert_allclose(rows[0], eq_37, atol=1e-11)
    np.testing.assert_allclose(rows[2], eq_38, atol=1e-11)
    assert relative(system.M_tilde, M - F.T @ H_inv @ F) < 1e-12
    assert relative(system.J_tilde, G - D @ H_inv @ F) < 1e-12
    reduced, reduced_rhs = system.reduced()
    np.testing.assert_allclose(
        reduced @ np.concatenate([dx, lam]) - reduced_rhs,
        np.concatenate([eq_37, eq_38]),
        atol=1e-11,
    )
