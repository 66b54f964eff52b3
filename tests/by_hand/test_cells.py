"""The witness cell by cell: orderings, geometry, materials, and what it may import."""

from __future__ import annotations

import ast
import dataclasses
import pathlib
import re
import sys

import numpy as np
import pytest

import demos.by_hand
from demos.by_hand import (
    ERRATA,
    MATERIALS,
    Corotational,
    SeedSystem,
    StableNeoHookean,
    State,
    dof_weights,
    lame_parameters,
    symmetric_dofs,
    symmetric_tensor,
)
from tests.by_hand.systems import (
    DIMENSIONS,
    LAM,
    MU,
    make_mesh,
    make_system,
    symmetric_noise,
)

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks


def imported(path):
    """The modules that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(node.module)
    return names


def test_the_witness_imports_nothing_of_the_ufl_side():
    """What imports both sides lies in `compare`, which the witness does not import."""
    folder = pathlib.Path(demos.by_hand.__file__).parent
    comparison = set((folder / "compare").rglob("*.py"))
    names = set().union(*(imported(path) for path in set(folder.rglob("*.py")) - comparison))
    foreign = {
        name
        for name in names
        if name.split(".")[0] not in {"numpy", "scipy", *sys.stdlib_module_names}
        and (not name.startswith("demos.by_hand") or name.startswith("demos.by_hand.compare"))
    }
    assert "numpy" in names
    assert not foreign
    both = set().union(*(imported(path) for path in comparison))
    assert {"forms", "demos.by_hand"} <= both


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


def test_where_the_hessian_of_stable_neo_hookean_is_singular():
    """At S = a I with ν = 0.3, as (30) is corrected: three a, indefinite between and beyond."""
    material = StableNeoHookean(*lame_parameters(1.0, 0.3))

    def eigenvalues(a):
        return np.linalg.eigvalsh(material.H(symmetric_dofs(a * np.eye(3))[None])[0])

    stated = [float(a) for a in re.findall(r"\d\.\d{3}", ERRATA[29].reason)]
    assert len(stated) == 3
    for a, definite in zip(stated, (True, False, True), strict=True):
        below, above = eigenvalues(a - 1e-3), eigenvalues(a + 1e-3)
        assert (below[0] > 0.0) == definite
        assert (above[0] > 0.0) == (not definite)
