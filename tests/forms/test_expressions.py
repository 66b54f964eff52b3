"""Expressions at points, and that what is written down twice is the same."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem

from forms.expressions import at_points
from tests.states import random_values, small_mesh

POINTS = np.full((1, 2), 1 / 3)


def stretch():
    """A tensor field, and its values on the owned cells."""
    msh = small_mesh(2)
    S = fem.Function(fem.functionspace(msh, ("DG", 0, (2, 2))))
    S.x.array[:] = random_values(S, 1)
    cells = np.arange(msh.topology.index_map(2).size_local, dtype=np.int32)
    return S, cells, S.x.array.reshape(-1, 2, 2)[: len(cells)]


def stress(S):
    """∂(S : S)²/∂S = 4 (S : S) S."""
    at = ufl.variable(S)
    return ufl.diff(ufl.inner(at, at) ** 2, at)


def test_written_twice_it_is_the_same():
    S, cells, values = stretch()
    first, second = stress(S), stress(S)
    assert first != second
    compiled = at_points(first, POINTS)
    assert compiled.ufl_expression == at_points(second, POINTS).ufl_expression
    squares = np.sum(values**2, axis=(1, 2), keepdims=True)
    found = compiled.eval(S.function_space.mesh, cells)[:, 0]
    np.testing.assert_allclose(found, 4 * squares * values, rtol=1e-13)


def test_variables_stay_apart():
    """∂(V : W)/∂V = W, though both come of S."""
    S, cells, values = stretch()
    V, W = ufl.variable(S), ufl.variable(2 * S)
    by_V = ufl.diff(ufl.inner(V, W), V) + stress(S)
    found = at_points(by_V - stress(S), POINTS).eval(S.function_space.mesh, cells)[:, 0]
    np.testing.assert_allclose(found, 2 * values, rtol=1e-12, atol=1e-13)
