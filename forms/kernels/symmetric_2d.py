"""Loops and matrix of `forms.kernels.symmetric` on triangles."""

from __future__ import annotations

from typing import Any

from forms.kernels import triangle
from forms.kernels.compile import Array, carray, cell_kernel, compiled, local_array
from forms.kernels.loops import symmetric_loops
from forms.kernels.triangle import (
    blocks_to_matrix,
    differences,
    displacement_gradient,
    fill_blocks,
    geometry,
    law,
    plus_identity,
    polar,
    project,
    set_pulled_back,
    symmetric_dofs,
)

residual, eliminate, recover, energy = symmetric_loops(triangle)


@compiled
def set_matrix(w: Array, X: Array, A: Array, projected: bool) -> None:
    """A cell's condensed matrix; w packs u, S, Y and (kind, μ, λ)."""
    u, SY = w[:6].reshape((3, 2)), w[6:12].reshape((2, 3))
    volume, g = geometry(differences(X, 0, 1, 2))
    F = plus_identity(displacement_gradient(differences(u, 0, 1, 2), g))
    R, s_F, T_inverse = polar(F)
    s, y = symmetric_dofs(SY, 0), symmetric_dofs(SY, 1)
    _, h, c, lam, N = law(w[12], w[13], w[14], s)
    C = carray(local_array(16), (4, 4))
    fill_blocks(s_F, T_inverse, y, h, c, lam, N, C)
    if projected:
        project(s, h, c, lam, N, C)
    blocks_to_matrix(C)
    set_pulled_back(C, R, volume, g, A)


def _exact(A: Any, w: Any, _c: Any, X: Any, _i: Any, _p: Any, _d: Any) -> None:
    set_matrix(carray(w, 15), carray(X, (3, 3)), carray(A, (6, 6)), False)


def _projected(A: Any, w: Any, _c: Any, X: Any, _i: Any, _p: Any, _d: Any) -> None:
    set_matrix(carray(w, 15), carray(X, (3, 3)), carray(A, (6, 6)), True)


def matrix_kernel(projected: bool) -> int:
    """The address of the condensed matrix's kernel."""
    return int(cell_kernel(_projected if projected else _exact).address)
