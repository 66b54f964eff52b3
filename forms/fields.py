"""The unknowns: P1 displacement, DG0 right stretch, DG0 multiplier (seed, sections 1.1-1.2)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from dolfinx import fem, mesh


def displacement_field(msh: mesh.Mesh) -> fem.Function:
    """Return the P1 displacement u = x - X [m], zero at first.

    Args:
        msh: Triangles in 2D or tetrahedra in 3D.

    Raises:
        ValueError: The cells are not triangles in 2D or tetrahedra in 3D.
    """
    d = msh.geometry.dim
    if msh.topology.cell_type != (None, None, mesh.CellType.triangle, mesh.CellType.tetrahedron)[d]:
        raise ValueError(
            f"the mesh has cells of type {msh.topology.cell_type.name} in {d}D; "
            "P1/DG0 fields need triangles in 2D or tetrahedra in 3D"
        )
    return fem.Function(fem.functionspace(msh, ("P", 1, (d,))), name="u")


def mixed_fields(
    msh: mesh.Mesh, multiplier: Literal["symmetric", "full"] = "symmetric"
) -> tuple[fem.Function, fem.Function, fem.Function]:
    """Return (u, S, Y) or (u, S, Lam) in the rest state: u = 0, S = I, no stress.

    Args:
        msh: Triangles in 2D or tetrahedra in 3D.
        multiplier: "symmetric" for Y, with Λ = R Y; "full" for the seed's Λ, of which three
            components per tetrahedron (one per triangle) carry nothing (see `forms.seed`).

    Returns:
        The displacement u [m] in P1 of shape (d,), the right stretch S [-] in symmetric DG0 of
        shape (d, d), the multiplier [Pa] in symmetric or full DG0 of shape (d, d).

    Raises:
        ValueError: Unsupported cells, or `multiplier` is neither "symmetric" nor "full".
    """
    if multiplier not in ("symmetric", "full"):
        raise ValueError(f'multiplier is {multiplier!r}; it must be "symmetric" or "full"')
    u = displacement_field(msh)
    d = msh.geometry.dim
    symmetric_dg0 = fem.functionspace(msh, ("DG", 0, (d, d), True))
    S = fem.Function(symmetric_dg0, name="S")
    # Components of a symmetric tensor in the order 00, 10, 11, 20, 21, 22.
    S.x.array[:] = np.tile(np.eye(d)[np.tril_indices(d)], len(S.x.array) // (d * (d + 1) // 2))
    if multiplier == "symmetric":
        return u, S, fem.Function(symmetric_dg0, name="Y")
    return u, S, fem.Function(fem.functionspace(msh, ("DG", 0, (d, d))), name="Lam")
