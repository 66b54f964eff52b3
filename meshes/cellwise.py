"""Any finite element function as an array in file order, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx.fem import Function, FunctionSpace

from meshes.body import Body

Array = npt.NDArray[Any]


def gather_all(body: Body, f: Function[Any]) -> Array | None:
    """All degrees of freedom of a function, in the same order on any number of ranks. Collective.

    Args:
        body: The body on whose mesh it is.
        f: Lagrange of any degree, discontinuous or at quadrature points.

    Returns:
        On rank 0 a row for each vertex of a continuous function of degree 1, else one for each
        cell, with all degrees of freedom on it; None elsewhere.
    """
    V = f.function_space
    if _is_by_vertex(V):
        return body.gather(f)
    blocks = V.dofmap.list[: len(body.file_cells)]
    values = f.x.array.reshape(-1, V.dofmap.index_map_bs)[blocks]
    return body.gather(values.reshape(len(blocks), blocks.shape[1] * V.dofmap.index_map_bs))


def put_all(body: Body, f: Function[Any], values: Array) -> None:
    """Set a function to what `gather_all` has returned.

    Args:
        body: A body with the same file.
        f: A function of the same kind.
        values: The same on all ranks.

    Raises:
        ValueError: Another number of values.
    """
    V = f.function_space
    if _is_by_vertex(V):
        body.put(f, values)
        return
    blocks, bs = V.dofmap.list, V.dofmap.index_map_bs
    if values.shape != (body.num_cells, blocks.shape[1] * bs):
        raise ValueError(
            f"values of shape {values.shape} are given for {f.name}; it has "
            f"{blocks.shape[1] * bs} on each of {body.num_cells} cells"
        )
    rows = values[body.mesh.topology.original_cell_index]
    f.x.array.reshape(-1, bs)[blocks] = rows.reshape(*blocks.shape, bs)


def _is_by_vertex(V: FunctionSpace[Any]) -> bool:
    element = V.ufl_element()
    if element.has_custom_quadrature:
        return False
    basix_element = V.element.basix_element
    return (
        basix_element.degree == 1
        and not basix_element.discontinuous
        and np.prod(V.value_shape) == V.dofmap.index_map_bs
    )
