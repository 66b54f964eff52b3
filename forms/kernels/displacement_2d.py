"""Loops of `forms.kernels.displacement` on triangles.

The tangent is that of the formulation with Y at S = S_F, Y = ∂Ψ/∂S; see there for its projection.
"""

from __future__ import annotations

import sys

from forms.kernels.compile import Array, carray, compiled, local_array
from forms.kernels.loops import displacement_loops
from forms.kernels.triangle import DIMENSION as DIMENSION
from forms.kernels.triangle import (
    Tuple,
    blocks_to_matrix,
    density,
    fill_blocks,
    full,
    law,
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


@compiled
def set_matrix(
    volume: float,
    g: Tuple,
    F: Tuple,
    material: tuple[float, float, float],
    projected: bool,
    A: Array,
) -> None:
    """A cell's tangent matrix."""
    R, s, T_inverse = polar(F)
    kind, mu, lam = material
    tau, h, c, lam, N = law(kind, mu, lam, s)
    C = carray(local_array(16), (4, 4))
    fill_blocks(s, T_inverse, tau, h, c, lam, N, C)
    if projected:
        project(s, h, c, lam, N, C)
    blocks_to_matrix(C)
    set_pulled_back(C, R, volume, g, A)


residual, matrix, energy = displacement_loops(sys.modules[__name__])
