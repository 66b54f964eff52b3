"""The unknowns: displacement, right stretch, multiplier (seed, sections 1.1-1.2)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from dolfinx import fem, mesh

from forms.points import CELLS, local_space, quadrature_degree


def displacement_field(msh: mesh.Mesh, degree: int = 1) -> fem.Function:
    """Return the displacement u = x - X [m], zero at first.

    Args:
        msh: Triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D.
        degree: Of the Lagrange element.

    Raises:
        ValueError: The mesh is a surface or has other cells, or the degree is not positive.
    """
    d = msh.geometry.dim
    if msh.topology.cell_type not in CELLS.get(d, ()):
        raise ValueError(
            f"the mesh has cells of type {msh.topology.cell_type.name} in {d}D; "
            "it must have triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D"
        )
    if degree < 1:
        raise ValueError(f"degree is {degree}; a continuous displacement has degree 1 or more")
    return fem.Function(fem.functionspace(msh, ("P", degree, (d,))), name="u")


def mixed_fields(
    msh: mesh.Mesh,
    multiplier: Literal["symmetric", "full"] = "symmetric",
    *,
    degree: int = 1,
) -> tuple[fem.Function, fem.Function, fem.Function]:
    """Return (u, S, Y) or (u, S, Lam) in the rest state: u = 0, S = I, no stress.

    Args:
        msh: Triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D.
        multiplier: "symmetric" for Y, with Λ = R Y; "full" for the seed's Λ, of which three
            components per tetrahedron (one per triangle) carry nothing (see `forms.seed`).
        degree: Of the displacement.

    Returns:
        The displacement u [m] of shape (d,), the right stretch S [-], symmetric of shape (d, d),
        the multiplier [Pa], symmetric or full of shape (d, d). S and the multiplier are DG0 with P1
        on simplices, else they live at quadrature points (`forms.points`).

    Raises:
        ValueError: Unsupported cells or degree, or `multiplier` is neither "symmetric" nor "full".
    """
    if multiplier not in ("symmetric", "full"):
        raise ValueError(f'multiplier is {multiplier!r}; it must be "symmetric" or "full"')
    u = displacement_field(msh, degree)
    d, points = msh.geometry.dim, quadrature_degree(u.function_space)
    symmetric = local_space(msh, points, (d, d), symmetric=True)
    S = fem.Function(symmetric, name="S")
    set_everywhere(S, np.eye(d))
    if multiplier == "symmetric":
        return u, S, fem.Function(symmetric, name="Y")
    return u, S, fem.Function(local_space(msh, points, (d, d)), name="Lam")


def set_everywhere(f: fem.Function, value: npt.ArrayLike) -> None:
    """Set a cell-local field to the same value everywhere.

    Args:
        f: DG0, or at quadrature points.
        value: Of the shape of f; of a symmetric tensor the lower triangle counts.
    """
    components = np.asarray(value, dtype=float)
    bs = f.function_space.dofmap.index_map_bs
    if components.size > bs:
        # Components of a symmetric tensor in the order 00, 10, 11, 20, 21, 22.
        components = components[np.tril_indices(len(components))]
    f.x.array.reshape(-1, bs)[:] = components.ravel()
