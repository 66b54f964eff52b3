"""The unknowns: displacement, right stretch, multiplier (seed, sections 1.1-1.2)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from dolfinx import fem, mesh

from forms.points import CELLS, local_space, quadrature_degree, rule_degree
from forms.spaces import function, function_space


def displacement_field(msh: mesh.Mesh, degree: int = 1) -> fem.Function:
    """Return the displacement u = x - X [m], zero at first.

    Args:
        msh: Triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D.
        degree: Of the Lagrange element.

    Raises:
        ValueError: The mesh is a surface, has other or curved cells, or the degree is not positive.
    """
    d = msh.geometry.dim
    if msh.topology.cell_type not in CELLS.get(d, ()):
        raise ValueError(
            f"the mesh has cells of type {msh.topology.cell_type.name} in {d}D; "
            "it must have triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D"
        )
    require_straight(msh)
    if degree < 1:
        raise ValueError(f"degree is {degree}; a continuous displacement has degree 1 or more")
    return function(function_space(msh, ("P", degree, (d,))), name="u")


def require_straight(msh: mesh.Mesh) -> None:
    """Insist on cells with straight edges, on which the points of the method are enough.

    On curved simplices F is not constant, and a mixed formulation would not have the positions of
    the displacement method.

    Raises:
        ValueError: The geometry is of second order or higher.
    """
    for cell in msh.geometry.cmaps:
        if cell.degree > 1:
            raise ValueError(
                f"the mesh has curved cells (geometry of degree {cell.degree}); it must have "
                "straight ones, of degree 1"
            )


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
    S = function(symmetric, name="S")
    set_everywhere(S, np.eye(d))
    if multiplier == "symmetric":
        return u, S, function(symmetric, name="Y")
    return u, S, function(local_space(msh, points, (d, d)), name="Lam")


def point_field(
    msh: mesh.Mesh,
    value: npt.ArrayLike = 0.0,
    *,
    degree: int = 1,
    symmetric: bool = False,
    name: str = "",
) -> fem.Function:
    """Return a field of data or of history where S lives (`forms.points`), the same everywhere.

    Args:
        msh: The mesh.
        value: Its value, which gives it its shape.
        degree: Of the displacement.
        symmetric: Whether it is a symmetric tensor.
        name: Of the field.
    """
    value = np.asarray(value, dtype=float)
    space = local_space(msh, rule_degree(msh, degree), value.shape, symmetric=symmetric)
    f = function(space, name=name)
    set_everywhere(f, value)
    return f


def set_everywhere(f: fem.Function, value: npt.ArrayLike) -> None:
    """Set a cell-local field to the same value everywhere.

    Args:
        f: DG0, or at quadrature points.
        value: Of the shape of f; of a symmetric tensor the lower triangle counts.
    """
    bs = f.function_space.dofmap.index_map_bs
    f.x.array.reshape(-1, bs)[:] = components(np.asarray(value, dtype=float)[None], bs)


def components(values: npt.NDArray[np.float64], block_size: int) -> npt.NDArray[np.float64]:
    """Return values as a space keeps them: a symmetric tensor by 00, 10, 11, 20, 21, 22.

    Args:
        values: Shape (n, *shape of a value).
        block_size: Of the space.

    Returns:
        Shape (n, block_size).
    """
    if np.prod(values.shape[1:]) > block_size:
        values = values[:, *np.tril_indices(values.shape[-1])]
    return values.reshape(-1, block_size)


def cell_not_finite(V: fem.FunctionSpace, values: npt.NDArray[np.float64]) -> int | None:
    """Return the first cell, by its number in the mesh file, on which values are not finite.

    Collective.

    Args:
        V: Their space.
        values: Of this rank's degrees of freedom, with or without those of ghosts.

    Returns:
        None where all are finite, on any rank.
    """
    bs, index_map = V.dofmap.index_map_bs, V.dofmap.index_map
    bad = np.zeros(index_map.size_local + index_map.num_ghosts, dtype=bool)
    bad[: len(values) // bs] = ~np.isfinite(values.reshape(-1, bs)).all(axis=1)
    numbers = V.mesh.topology.original_cell_index[bad[V.dofmap.list].any(axis=1)]
    found = [int(n.min()) for n in V.mesh.comm.allgather(numbers) if len(n)]
    return min(found, default=None)
