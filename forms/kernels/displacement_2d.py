"""Loops and matrix of `forms.kernels.displacement` on triangles.

The tangent is that of the formulation with Y at S = S_F, Y = ∂Ψ/∂S; see there for its projection.
"""

from __future__ import annotations

import sys
from typing import Any

from forms.kernels.compile import Array, carray, cell_kernel, compiled, local_array
from forms.kernels.loops import displacement_loops
from forms.kernels.triangle import (
    Tuple,
    blocks_to_matrix,
    density,
    differences,
    displacement_gradient,
    fill_blocks,
    full,
    geometry,
    law,
    plus_identity,
    polar,
    project,
    set_pulled_back,
    times,
)
from forms.kernels.triangle import add_stress as add_stress
from forms.kernels.triangle import cell_deformation as cell_deformation


@compiled
def stress(kind: float, mu: float, lam: float, F: Tuple) -> Tuple:
    """The first Piola-Kirchhoff stress ∂Ψ(S_F)/∂F."""
    R, s, _ = polar(F)
    tau, _, _, _, _ = law(kind, mu, lam, s)
    return times(R, full(tau))


@compiled
def cell_energy(kind: float, mu: float, lam: float, F: Tuple) -> float:
    """Ψ(S_F) [J/m³]."""
    _, s, _ = polar(F)
    return density(kind, mu, lam, s)


residual, energy = displacement_loops(sys.modules[__name__])


@compiled
def set_matrix(w: Array, X: Array, A: Array, projected: bool) -> None:
    """A cell's tangent matrix; w packs u and (kind, μ, λ)."""
    u = w[:6].reshape((3, 2))
    volume, g = geometry(differences(X, 0, 1, 2))
    F = plus_identity(displacement_gradient(differences(u, 0, 1, 2), g))
    R, s, T_inverse = polar(F)
    tau, h, c, lam, N = law(w[6], w[7], w[8], s)
    C = carray(local_array(16), (4, 4))
    fill_blocks(s, T_inverse, tau, h, c, lam, N, C)
    if projected:
        project(s, h, c, lam, N, C)
    blocks_to_matrix(C)
    set_pulled_back(C, R, volume, g, A)


def _exact(A: Any, w: Any, _c: Any, X: Any, _i: Any, _p: Any, _d: Any) -> None:
    set_matrix(carray(w, 9), carray(X, (3, 3)), carray(A, (6, 6)), False)


def _projected(A: Any, w: Any, _c: Any, X: Any, _i: Any, _p: Any, _d: Any) -> None:
    set_matrix(carray(w, 9), carray(X, (3, 3)), carray(A, (6, 6)), True)


def matrix_kernel(projected: bool) -> int:
    """The address of the tangent matrix's kernel."""
    return int(cell_kernel(_projected if projected else _exact).address)
