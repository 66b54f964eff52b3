"""Loops of `forms.kernels.symmetric` on triangles."""

from __future__ import annotations

import sys

from forms.kernels import triangle
from forms.kernels.compile import Array, carray, compiled, local_array
from forms.kernels.loops import symmetric_loops
from forms.kernels.triangle import KEPT as KEPT
from forms.kernels.triangle import (
    Tuple,
    blocks_to_matrix,
    fill_blocks,
    law,
    project,
    set_pulled_back,
)


@compiled
def set_matrix(
    volume: float,
    g: Tuple,
    polar: tuple[Tuple, Tuple, float],
    s: Tuple,
    y: Tuple,
    material: tuple[float, float, float],
    projected: bool,
    A: Array,
) -> None:
    """A cell's condensed matrix."""
    R, s_F, T_inverse = polar
    kind, mu, lam = material
    _, h, c, lam, N = law(kind, mu, lam, s)
    C = carray(local_array(16), (4, 4))
    fill_blocks(s_F, T_inverse, y, h, c, lam, N, C)
    if projected:
        project(s, h, c, lam, N, C)
    blocks_to_matrix(C)
    set_pulled_back(C, R, volume, g, A)


kinematics, residual, matrix, eliminate, recover, energy = symmetric_loops(
    triangle, sys.modules[__name__]
)
