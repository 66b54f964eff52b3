"""The hand-derived discrete system against finite differences of its own energy.

The ground truth is the discrete energy (2)/(5). Nothing here uses MPI or UFL: every rank runs the
same.
"""

from __future__ import annotations

import ast
import dataclasses
import itertools
import pathlib

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

import forms.discrete
from forms.discrete import (
    ERRATA,
    MATERIALS,
    Corotational,
    Polar,
    SeedSystem,
    StableNeoHookean,
    State,
    SymmetricSystem,
    dof_weights,
    signed_svd,
    skew_basis,
    solve_condensed,
    solve_kkt,
    solve_reduced,
    symmetric_basis,
    symmetric_dofs,
    symmetric_tensor,
)

MU, LAM = 1.3, 2.1  # [Pa]
EPS = 0.7  # [1/Pa]
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])
CHOICES = {
    "seed": lambda *a, **k: SeedSystem(*a, **k),
    "cured": lambda *a, **k: SeedSystem(*a, eps=EPS, **k),
    "symmetric": lambda *a, **k: SymmetricSystem(*a, **k),
}
FORMULATIONS = pytest.mark.parametrize("formulation", list(CHOICES))


# Fixtures and helpers


def make_mesh(d, rng):
    """A distorted square of four triangles or cube of six tetrahedra."""
    if d == 2:
        X = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.4, 0.6]], dtype=float)
        cells = np.array([[0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]])
    else:
        X = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)
        cells = np.array(
            [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]]
        )
    return X + 0.08 * rng.standard_normal(X.shape), cells


def symmetric_noise(rng, n, d, size):
    noise = size * rng.standard_normal((n, d, d))
    return 0.5 * (noise + np.swapaxes(noise, 1, 2))


def rotation_matrix(d, rng):
    Q, _ = np.linalg.qr(rng.standard_normal((d, d)))
    return Q * np.array([np.sign(np.linalg.det(Q))] + [1.0] * (d - 1))


def make_system(d, formulation, kind="infeasible", material=None, seed=0, **options):
    """A system at rest, at a random feasible state (S = S(F), Λ = R Y) or at a random one."""
    rng = np.random.default_rng(seed)
    X, cells = make_mesh(d, rng)
    n = len(cells)
    if kind == "rest":
        state = State.at_rest(X, cells)
    else:
        gradient = rotation_matrix(d, rng) @ (np.eye(d) + 0.2 * rng.standard_normal((d, d)))
        x = X @ gradient.T + 0.08 * rng.standard_normal(X.shape)
        polar = SymmetricSystem(
            dataclasses.replace(State.at_rest(X, cells), x=x), Corotational(1.0)
        ).polar
        Y = symmetric_noise(rng, n, d, 0.8)
        if kind == "feasible":
            S = symmetric_tensor(symmetric_dofs(polar.S))
            Lam = polar.R @ Y
        else:
            S = np.eye(d) + symmetric_noise(rng, n, d, 0.3)
            Lam = rng.standard_normal((n, d, d))
        state = State(X, cells, x, S, Y if formulation == "symmetric" else Lam)
    values = {
        "rho": rng.uniform(0.5, 2.0, n),
        "h": 0.4,
        "v": rng.standard_normal(X.shape),
        "f_ext": rng.standard_normal(d),
        "x_n": state.x + 0.1 * rng.standard_normal(X.shape),
    }
    material = StableNeoHookean(MU, LAM) if material is None else material
    return CHOICES[formulation](state, material, **{**values, **options})


def sizes(system):
    return system.g_x.size, system.g_s.size, system.lam.size


def split(system, vector):
    return np.split(vector, np.cumsum(sizes(system))[:-1])


def random_step(system, seed=1):
    return np.random.default_rng(seed).standard_normal(sum(sizes(system)))


def central(f, direction, step):
    return (f(step * direction) - f(-step * direction)) / (2.0 * step)


def assert_derivative(f, derivative, direction, tolerance=1e-7):
    """Central differences of f at 0 approach the derivative with order 2."""
    scale = max(np.linalg.norm(derivative), 1e-3)
    coarse, fine, finest = (
        np.linalg.norm(central(f, direction, step) - derivative) / scale
        for step in (4e-3, 2e-3, 1e-5)
    )
    assert finest < tolerance
    if coarse > 1e-9:  # else f is quadratic at most and the difference exact
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def relative(a, b):
    a, b = (m.toarray() if sp.issparse(m) else np.asarray(m) for m in (a, b))
    return np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-300)


def deformations(d, seed=0, n=5):
    """Random F: distinct singular values, some inverted, in the d = 3 case not nearly singular."""
    rng = np.random.default_rng(seed)
    U = np.stack([rotation_matrix(d, rng) for _ in range(n)])
    V = np.stack([rotation_matrix(d, rng) for _ in range(n)])
    sigma = np.sort(rng.uniform(0.3, 0.5, (n, d)), axis=1)[:, ::-1] + np.arange(d)[::-1] * 0.5
    sigma[::2, -1] *= -1.0
    return np.einsum("nia,na,nja->nij", U, sigma, V)


# Orderings, geometry


def test_imports_nothing_of_the_ufl_side():
    folder = pathlib.Path(forms.discrete.__file__).parent
    names = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names.add(node.module)
    standard = {"__future__", "abc", "dataclasses", "functools", "math", "typing"}
    foreign = {
        name
        for name in names - standard
        if name.split(".")[0] not in ("numpy", "scipy") and not name.startswith("forms.discrete")
    }
    assert "numpy" in names
    assert not foreign


def test_symmetric_dofs_are_the_lower_triangle_row_by_row():
    S = symmetric_tensor(np.array([[0.0, 10.0, 11.0, 20.0, 21.0, 22.0]]))[0]
    np.testing.assert_array_equal(S, [[0, 10, 20], [10, 11, 21], [20, 21, 22]])
    rng = np.random.default_rng(0)
    y, s = rng.standard_normal((2, 4, 6))
    np.testing.assert_allclose(
        np.einsum("nij,nij->n", symmetric_tensor(y), symmetric_tensor(s)), y * s @ dof_weights(3)
    )


@DIMENSIONS
def test_jacobian_gives_the_deformation_gradient_of_an_affine_map(d):
    """Eq. (4): F of x = A X + b is A in every cell, and J x = vec F row-major."""
    rng = np.random.default_rng(0)
    X, cells = make_mesh(d, rng)
    A, b = rng.standard_normal((d, d)), rng.standard_normal(d)
    state = dataclasses.replace(State.at_rest(X, cells), x=X @ A.T + b)
    system = SeedSystem(state, Corotational(MU, LAM))
    for vec_F in (system.J @ state.x.ravel()).reshape(-1, d * d):
        np.testing.assert_allclose(vec_F, A.ravel(), atol=1e-13)


@DIMENSIONS
def test_mass_matrix_integrates_quadratics(d):
    """½ vᵀ M v of a linear velocity equals a quadrature of degree 2; the volumes fill the body."""
    system = make_system(d, "seed")
    X, cells, rho = system.state.X, system.state.cells, system.rho
    a = {2: 1 / 6, 3: (5 - np.sqrt(5)) / 20}[d]
    points = np.full((d + 1, d + 1), a) + (1 - (d + 1) * a) * np.eye(d + 1)
    v = X @ np.random.default_rng(2).standard_normal((d, d)) + 0.3
    at_points = np.einsum("qa,nai->nqi", points, v[cells])
    expected = np.sum(rho * system.volume * np.mean(np.sum(at_points**2, axis=2), axis=1))
    assert v.ravel() @ (system.M @ v.ravel()) == pytest.approx(expected, rel=1e-13)


# Rotation


@DIMENSIONS
def test_polar_decomposition_of_inverted_cells_too(d):
    """Eq. (14) holds with U and V in SO(d); with σ ≥ 0 R is a reflection where det F < 0."""
    F = deformations(d)
    polar = Polar(F)
    identity = np.broadcast_to(np.eye(d), F.shape)
    np.testing.assert_allclose(np.swapaxes(polar.R, 1, 2) @ polar.R, identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(polar.R), 1.0)
    np.testing.assert_allclose(polar.R @ polar.S, F, atol=1e-14)
    np.testing.assert_allclose(polar.S, np.swapaxes(polar.S, 1, 2), atol=1e-14)
    U, _, Vt = np.linalg.svd(F)
    np.testing.assert_allclose(np.linalg.det(U @ Vt), np.sign(np.linalg.det(F)))
    assert np.any(np.linalg.det(F) < 0) and np.any(np.linalg.det(F) > 0)


@DIMENSIONS
def test_derivatives_of_singular_vectors(d):
    F = deformations(d)
    U0, _, V0 = signed_svd(F)
    direction = np.random.default_rng(1).standard_normal(F.shape)

    def vectors(dF):
        U, _, V = signed_svd(F + dF)
        sign = np.sign(np.einsum("nia,nia->na", U, U0))[:, None, :]  # pairs (u, v) have a free sign
        return np.stack([U * sign, V * sign])

    np.testing.assert_allclose(vectors(0.0 * F), np.stack([U0, V0]), atol=1e-14)
    dU, dV = Polar(F).svd_derivatives
    derivative = np.einsum("mnijkl,nkl->mnij", np.stack([dU, dV]), direction)
    assert_derivative(vectors, derivative, direction)


@DIMENSIONS
def test_equation_15_and_its_closed_form(d):
    """∂U Vᵀ + U ∂Vᵀ is the closed form at distinct σ and does not exist at rest."""
    polar = Polar(deformations(d))
    U, _, V = polar.svd
    dU, dV = polar.svd_derivatives
    printed = np.einsum("niakl,nja->nijkl", dU, V) + np.einsum("nia,njakl->nijkl", U, dV)
    assert relative(polar.dR, printed) < 1e-12
    with pytest.raises(ValueError, match="two singular values agree"):
        _ = Polar(np.eye(d)[None]).svd_derivatives


@DIMENSIONS
@pytest.mark.parametrize("at", ["rest", "random"])
def test_derivatives_of_rotation_and_stretch(d, at):
    F = deformations(d) if at == "random" else np.eye(d)[None]
    polar = Polar(F)
    direction = np.random.default_rng(1).standard_normal(F.shape)
    for name in ("R", "S"):
        derivative = np.einsum("nijkl,nkl->nij", getattr(polar, f"d{name}"), direction)
        assert_derivative(lambda dF, name=name: getattr(Polar(F + dF), name), derivative, direction)
    spin = np.einsum("nakl,nkl,aij->nij", polar.spin, direction, skew_basis(d))
    np.testing.assert_allclose(
        polar.R @ spin, np.einsum("nijkl,nkl->nij", polar.dR, direction), atol=1e-12
    )


@DIMENSIONS
@pytest.mark.parametrize("at", ["rest", "random"])
def test_second_derivatives_of_rotation_and_stretch(d, at):
    """The core of eq. (24), at rest and in inverted cells."""
    F = deformations(d) if at == "random" else np.eye(d)[None]
    rng = np.random.default_rng(1)
    B, direction = rng.standard_normal((2, *F.shape))
    Y = B + np.swapaxes(B, 1, 2)
    for tensor, name, hessian in (
        (B, "R", Polar(F).rotation_hessian(B)),
        (Y, "S", Polar(F).stretch_hessian(Y)),
    ):
        np.testing.assert_allclose(hessian, np.swapaxes(hessian, 1, 2), atol=1e-13)

        def gradient(dF, tensor=tensor, name=name):
            """By the first derivative alone, which has its own test."""
            d_name = getattr(Polar(F + dF), f"d{name}")
            return np.einsum("nij,nijkl->nkl", tensor, d_name).reshape(len(F), -1)

        derivative = np.einsum("npq,nq->np", hessian, direction.reshape(len(F), -1))
        assert_derivative(gradient, derivative, direction)
    np.testing.assert_allclose(
        Polar(F).rotation_gradient(B), np.einsum("nij,nijkl->nkl", B, Polar(F).dR), atol=1e-12
    )
    np.testing.assert_allclose(
        Polar(F).stretch_gradient(Y), np.einsum("nij,nijkl->nkl", Y, Polar(F).dS), atol=1e-12
    )


@DIMENSIONS
def test_stretch_hessian_equals_the_form_with_a_sylvester_equation(d):
    """Y : ∂²S = 2 Z : (δFᵀδF - δS δS) with Z S + S Z = Y."""
    F = np.abs(np.linalg.det(deformations(d)))[:, None, None] * 0.2 * np.eye(d) + deformations(d, 3)
    polar = Polar(F)
    rng = np.random.default_rng(1)
    Y = symmetric_noise(rng, len(F), d, 1.0)
    dF = rng.standard_normal(F.shape)
    _, sigma, V = polar.svd
    VYV = np.einsum("nia,nij,njb->nab", V, Y, V) / (sigma[:, :, None] + sigma[:, None, :])
    Z = np.einsum("nia,nab,njb->nij", V, VYV, V)
    dS = np.einsum("nijkl,nkl->nij", polar.dS, dF)
    expected = 2 * np.einsum("nij,nij->n", Z, np.swapaxes(dF, 1, 2) @ dF - dS @ dS)
    vec = dF.reshape(len(F), -1)
    actual = np.einsum("np,npq,nq->n", vec, polar.stretch_hessian(Y), vec)
    np.testing.assert_allclose(actual, expected, rtol=1e-10)


def test_rotation_derivative_is_refused_where_the_rotation_is_not_unique():
    with pytest.raises(ValueError, match=r"not unique .* cells \[1\]"):
        _ = Polar(np.stack([np.eye(3), np.diag([1.0, 1.0, -1.0])])).dR


# Materials


@DIMENSIONS
@pytest.mark.parametrize("name", list(MATERIALS))
def test_materials_by_complex_step(d, name):
    """g = ∂Ψ/∂s and H = ∂²Ψ/∂s² to round-off; rest is stress-free and H is symmetric."""
    n, step = 4, 1e-30
    rng = np.random.default_rng(0)
    material = MATERIALS[name](rng.uniform(1.0, 2.0, n), rng.uniform(1.0, 2.0, n))
    s = symmetric_dofs(np.eye(d) + symmetric_noise(rng, n, d, 0.5))
    for k, unit in enumerate(np.eye(s.shape[1])):
        moved = s + 1j * step * unit
        g = material.psi(moved).imag / step
        np.testing.assert_allclose(material.g(s)[:, k], g, rtol=1e-12, atol=1e-13)
        H = material.g(moved).imag / step
        np.testing.assert_allclose(material.H(s)[:, k], H, rtol=1e-12, atol=1e-13)
    rest = symmetric_dofs(np.broadcast_to(np.eye(d), (n, d, d)))
    np.testing.assert_allclose(material.psi(rest), 0.0, atol=1e-14)
    np.testing.assert_allclose(material.g(rest), 0.0, atol=1e-14)
    np.testing.assert_allclose(material.H(s), np.swapaxes(material.H(s), 1, 2), atol=1e-14)


# The discrete energy and its derivatives


@DIMENSIONS
@FORMULATIONS
@pytest.mark.parametrize("kind", ["rest", "feasible", "infeasible"])
def test_gradient_and_every_block_by_differences_of_the_energy(d, formulation, kind):
    """Energy (2) → gradient → the nine blocks of (35) with (24)."""
    system = make_system(d, formulation, kind)
    rng = np.random.default_rng(4)

    def moved(step):
        return system.moved(*split(system, step))

    direction = random_step(system)
    assert_derivative(
        lambda step: np.array([moved(step).energy()]),
        np.array([system.gradient() @ direction]),
        direction,
    )
    matrix, _ = system.kkt()
    edges = np.cumsum((0, *sizes(system)))
    for column in range(3):
        direction = np.zeros(edges[-1])
        part = slice(edges[column], edges[column + 1])
        direction[part] = rng.standard_normal(part.stop - part.start)
        product = split(system, matrix @ direction)
        for row in range(3):
            assert_derivative(
                lambda step, row=row: split(system, moved(step).gradient())[row],
                product[row],
                direction,
            )


@DIMENSIONS
@FORMULATIONS
def test_right_hand_side_is_for_the_new_multiplier(d, formulation):
    """K (0, 0, λ^t) - gradient = right-hand side, so that the solution's last part is λ^t + δλ."""
    system = make_system(d, formulation)
    matrix, rhs = system.kkt()
    zero = np.zeros(system.g_x.size + system.g_s.size)
    np.testing.assert_allclose(
        matrix @ np.concatenate([zero, system.lam]) - system.gradient(), rhs, atol=1e-13
    )


@DIMENSIONS
@FORMULATIONS
def test_dropping_second_derivatives_changes_one_block(d, formulation):
    system = make_system(d, formulation)
    frozen = dataclasses.replace(system, second_derivatives=False)
    difference = frozen.kkt()[0] - system.kkt()[0]
    n = system.g_x.size
    assert relative(difference[:n, :n], system.E_xx) < 1e-13
    assert abs(difference).sum() == pytest.approx(abs(difference[:n, :n]).sum())
    assert sp.linalg.norm(system.E_xx) > 0.1


# Rank and solves


@DIMENSIONS
@pytest.mark.parametrize("kind", ["rest", "feasible"])
def test_printed_system_has_a_null_space_and_the_cured_one_none(d, kind):
    """(35) and (41): d (d - 1) / 2 null vectors a cell, Λ = R skew, at feasible states."""

    def nullity(matrix):
        singular = np.linalg.svd(matrix.toarray(), compute_uv=False)
        return np.count_nonzero(singular < 1e-12 * singular[0])

    printed = make_system(d, "seed", kind)
    spins = d * (d - 1) // 2
    expected = spins * len(printed.state.cells)
    assert nullity(printed.kkt()[0]) == expected
    assert nullity(printed.reduced()[0]) == expected
    RE = np.einsum("nik,akj->naij", printed.polar.R, skew_basis(d))
    for a in range(spins):
        null = np.zeros(sum(sizes(printed)))
        null[-printed.lam.size :] = RE[:, a].ravel()
        np.testing.assert_allclose(printed.kkt()[0] @ null, 0.0, atol=1e-14)
    for formulation in ("cured", "symmetric"):
        system = make_system(d, formulation, kind)
        assert nullity(system.kkt()[0]) == nullity(system.reduced()[0]) == 0


@DIMENSIONS
def test_printed_schur_complement_is_rank_deficient_at_every_state(d):
    system = make_system(d, "seed", "infeasible")
    rank = np.linalg.matrix_rank(system.DHD.toarray(), tol=1e-11)
    assert rank == len(system.state.cells) * d * (d + 1) // 2


@DIMENSIONS
def test_printed_system_freezes_rotations_at_infeasible_states(d):
    """Its rows on R skew demand (tr(S - S_F) I - (S - S_F)) ω = 0 of the rotation increment."""
    system = make_system(d, "seed", "infeasible")
    X, cells = system.state.X[: d + 1], np.arange(d + 1)[None]
    one = State(X, cells, system.state.x[: d + 1], system.state.S[:1], system.state.Lam[:1])
    spin = {}
    for eps in (0.0, EPS):
        single = SeedSystem(one, system.material, h=0.4, f_ext=np.arange(d), eps=eps)
        matrix, rhs = single.kkt()
        dx = np.linalg.solve(matrix.toarray(), rhs)[: X.size]
        spin[eps] = np.abs(single.polar.spin.reshape(-1, d * d) @ (single.J @ dx)).max()
    assert spin[0.0] < 1e-10
    assert spin[EPS] > 1e-3


@DIMENSIONS
@FORMULATIONS
@pytest.mark.parametrize("kind", ["feasible", "infeasible"])
@pytest.mark.parametrize("second", [True, False])
def test_reduced_system_and_back_substitution_give_the_full_step(d, formulation, kind, second):
    """(41) with (36) solves (35), with clamped vertices."""
    system = make_system(d, formulation, kind, second_derivatives=second)
    fixed = np.arange(2 * d)
    full, reduced = solve_kkt(system, fixed), solve_reduced(system, fixed)
    for name in ("dx", "ds", "lam"):
        assert relative(getattr(reduced, name), getattr(full, name)) < 1e-11
    assert not np.any(full.dx[fixed])
    if formulation == "symmetric":
        condensed = solve_condensed(system, fixed)
        for name in ("dx", "ds", "lam"):
            assert relative(getattr(condensed, name), getattr(full, name)) < 1e-11


@DIMENSIONS
def test_condensed_matrix_is_the_schur_complement(d):
    system = make_system(d, "symmetric")
    matrix, rhs = (m.toarray() if sp.issparse(m) else m for m in system.kkt())
    n = system.g_x.size
    eliminate = np.linalg.solve(matrix[n:, n:], np.column_stack([matrix[n:, :n], rhs[n:]]))
    K, b = system.condensed()
    assert relative(K, matrix[:n, :n] - matrix[:n, n:] @ eliminate[:, :-1]) < 1e-12
    assert relative(b, rhs[:n] - matrix[:n, n:] @ eliminate[:, -1]) < 1e-12


@DIMENSIONS
def test_printed_system_is_solved_with_the_smallest_multiplier(d):
    """At a feasible state, against a dense least-squares solution of (35)."""
    system = make_system(d, "seed", "feasible")
    matrix, rhs = system.kkt()
    expected = np.linalg.lstsq(matrix.toarray(), rhs, rcond=1e-12)[0]
    np.testing.assert_allclose(matrix @ expected, rhs, atol=1e-11)
    step = solve_kkt(system)
    assert relative(np.concatenate([step.dx, step.ds, step.lam]), expected) < 1e-10


@DIMENSIONS
@pytest.mark.parametrize("name", list(MATERIALS))
def test_seed_and_symmetric_take_the_same_step_at_a_feasible_state(d, name):
    """δx, δs and the variation of sym(RᵀΛ), which is δY; Newton is invariant where c = 0."""
    material = MATERIALS[name](MU, LAM)
    seeds = [make_system(d, f, "feasible", material) for f in ("seed", "cured")]
    symmetric = make_system(d, "symmetric", "feasible", material)
    expected = solve_kkt(symmetric)
    Y = symmetric.multiplier_tensor(expected.lam)
    for system in seeds:
        step = solve_kkt(system)
        assert relative(step.dx, expected.dx) < 1e-10
        assert relative(step.ds, expected.ds) < 1e-10
        R = system.polar.R
        dF = (system.J @ step.dx).reshape(R.shape)
        dR = np.einsum("nijkl,nkl->nij", system.polar.dR, dF)
        product = np.swapaxes(R, 1, 2) @ system.multiplier_tensor(step.lam)
        product += np.swapaxes(dR, 1, 2) @ system.state.Lam
        assert relative(0.5 * (product + np.swapaxes(product, 1, 2)), Y) < 1e-10


def newton(system, fixed, iterations, solve=solve_kkt):
    residuals = []
    free = np.setdiff1d(np.arange(sum(sizes(system))), fixed)
    for _ in range(iterations):
        step = solve(system, fixed)
        system = system.moved(step.dx, step.ds, step.lam - system.lam)
        residuals.append(np.linalg.norm(system.gradient()[free]))
    return system, residuals


@DIMENSIONS
def test_newton_converges_quadratically_to_one_state_in_all_formulations(d):
    """Without ∂²R, as printed, it is linear."""
    rng = np.random.default_rng(0)
    X, cells = make_mesh(d, rng)
    fixed = np.arange(2 * d)
    final = {}
    for formulation in CHOICES:
        make = CHOICES[formulation]
        system = make(
            State.at_rest(X, cells), StableNeoHookean(1.0, 2.0), 1.0, 0.5, f_ext=np.full(d, -2.0)
        )
        final[formulation], residuals = newton(system, fixed, 9)
        assert residuals[-1] < 1e-12
        small = [r for r in residuals if 1e-12 < r < 1e-1]
        assert all(b < 20.0 * a**1.8 for a, b in itertools.pairwise(small))
        printed = dataclasses.replace(system, second_derivatives=False)
        _, slow = newton(printed, fixed, 9)
        assert slow[-1] > 1e3 * residuals[-1]
        assert slow[-1] < 0.5 * slow[-2]
    reference = final["symmetric"]
    for formulation in ("seed", "cured"):
        assert relative(final[formulation].state.x, reference.state.x) < 1e-11
        assert relative(final[formulation].state.S, reference.state.S) < 1e-11
        P = np.swapaxes(final[formulation].polar.R, 1, 2) @ final[formulation].state.Lam
        assert relative(P, reference.Y) < 1e-9


# Invariance


@DIMENSIONS
@FORMULATIONS
def test_rigid_motion_rotates_the_step(d, formulation):
    system = make_system(d, formulation)
    rng = np.random.default_rng(5)
    Q, b = rotation_matrix(d, rng), rng.standard_normal(d)
    state = system.state
    Lam = state.Lam if formulation == "symmetric" else Q @ state.Lam
    turned = dataclasses.replace(
        system,
        state=dataclasses.replace(state, x=state.x @ Q.T + b, Lam=Lam),
        x_n=system.start @ Q.T + b,
        v=system.v @ Q.T,
        f_ext=system.f_ext @ Q.T,
    )
    assert turned.energy() == pytest.approx(system.energy(), rel=1e-13)
    step, turned_step = solve_kkt(system), solve_kkt(turned)
    assert relative(turned_step.dx.reshape(-1, d), step.dx.reshape(-1, d) @ Q.T) < 1e-10
    assert relative(turned_step.ds, step.ds) < 1e-10
    lam = system.multiplier_tensor(step.lam)
    expected = lam if formulation == "symmetric" else Q @ lam
    assert relative(turned.multiplier_tensor(turned_step.lam), expected) < 1e-10


@DIMENSIONS
@FORMULATIONS
def test_renumbering_permutes_the_result(d, formulation):
    """Vertices, cells, and the order of vertices within a cell, odd permutations included."""
    system = make_system(d, formulation)
    rng = np.random.default_rng(6)
    state = system.state
    vertices, order = rng.permutation(len(state.X)), rng.permutation(len(state.cells))
    new_number = np.argsort(vertices)
    cells = rng.permuted(new_number[state.cells[order]], axis=1)
    renumbered = dataclasses.replace(
        system,
        state=State(state.X[vertices], cells, state.x[vertices], state.S[order], state.Lam[order]),
        rho=system.rho[order],
        v=system.v[vertices],
        x_n=system.x_n[vertices],
    )
    position = (d * vertices[:, None] + np.arange(d)).ravel()
    dofs = [position]
    offset = system.g_x.size
    for size in sizes(system)[1:]:
        block = size // len(order)
        dofs.append(offset + (block * order[:, None] + np.arange(block)).ravel())
        offset += size
    permutation = np.concatenate(dofs)
    assert relative(renumbered.kkt()[0], system.kkt()[0][permutation][:, permutation]) < 1e-13
    assert relative(renumbered.kkt()[1], system.kkt()[1][permutation]) < 1e-13


# Equation by equation: what is printed fails where the errata say so, the correction holds


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
    printed_or_corrected([5, 6, 7, 8], "holds as printed")
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
    printed_or_corrected([28, 29, 30, 31, 32, 33], "holds as printed")
    printed_or_corrected([34], "corrected")
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


# Interface


@FORMULATIONS
def test_every_block_can_be_replaced_and_changes_what_follows(formulation):
    system = make_system(3, formulation)

    def outcome(system):
        outputs = [*system.kkt(), *system.reduced(), system.gradient()]
        if formulation == "symmetric":
            outputs += system.condensed()
        return np.concatenate([(m.toarray() if sp.issparse(m) else m).ravel() for m in outputs])

    reference = outcome(system)
    for name in system.block_names():
        block = getattr(system, name)
        if np.linalg.norm(block.toarray() if sp.issparse(block) else block) == 0.0:
            continue
        changed = system.with_blocks(**{name: 1.001 * block})
        assert np.linalg.norm(outcome(changed) - reference) > 0.0, name
        np.testing.assert_array_equal(outcome(system), reference)
    with pytest.raises(ValueError, match="no block Q"):
        system.with_blocks(Q=np.eye(3))


def test_errors_name_what_is_wrong():
    X, cells = make_mesh(3, np.random.default_rng(0))
    state = State.at_rest(X, cells)
    material = Corotational(MU, LAM)
    with pytest.raises(ValueError, match=r"x has shape \(2, 3\)"):
        dataclasses.replace(state, x=X[:2])
    with pytest.raises(ValueError, match="outside"):
        dataclasses.replace(state, cells=cells + 5)
    with pytest.raises(ValueError, match="not symmetric"):
        dataclasses.replace(state, S=state.S + np.eye(3)[[1, 0, 2]] * [[1.0], [0.0], [0.0]])
    with pytest.raises(ValueError, match="h is 0"):
        SeedSystem(state, material, h=0.0)
    with pytest.raises(ValueError, match="eps is -1"):
        SeedSystem(state, material, eps=-1.0)
    with pytest.raises(ValueError, match=r"cells \[0\] are flat"):
        flat = X.copy()
        flat[cells[0, 3]] = flat[cells[0, :3]].mean(axis=0)
        _ = SeedSystem(State.at_rest(flat, cells[:1]), material).volume
    massless = SymmetricSystem(state, material, rho=0.0)
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        solve_kkt(dataclasses.replace(massless, f_ext=np.ones(3)).with_blocks(g_x=np.ones(X.size)))
