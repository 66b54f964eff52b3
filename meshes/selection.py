"""The part of a body that a clause names: some of its vertices, or of its tagged entities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh, entities_to_geometry, exterior_facet_indices

from meshes.errors import MeshError
from meshes.groups import Group, Integers
from meshes.where import AXES, Where

# Vertices count as lying on a plane within this fraction of the largest extent, or within a few
# roundings of the largest coordinate: single precision files round coordinates at 1e-7.
PLANE_TOLERANCE = 1e-6
_ROUNDING = 1.2e-7
# But never beyond this fraction of the extent across the plane, however thin the body.
_THINNEST = 1e-3


@dataclass(frozen=True)
class Selection:
    """What meets a clause on this rank.

    Attributes:
        vertices: Whether each local vertex of the geometry meets the conditions on vertices.
        dim: Dimension of the tagged entities, or None where the clause says nothing but which
            vertices are meant.
        entities: Local entities of that dimension, ghosts included, sorted.
        listed: Whether the clause lists the vertices, by number or tag, and does not say where
            they are.
    """

    vertices: npt.NDArray[np.bool_]
    dim: int | None = None
    entities: npt.NDArray[np.int32] | None = None
    listed: bool = False

    def local(self, msh: Mesh[np.float64], dim: int) -> npt.NDArray[np.int32]:
        """The entities of a dimension: the tagged ones, or those with all vertices in the set."""
        if self.entities is not None:
            assert dim == self.dim
            return self.entities
        every = _every(msh, dim)
        return every[self.vertices[_nodes(msh, dim, every)].all(axis=1)]

    def touched(self, msh: Mesh[np.float64]) -> npt.NDArray[np.integer]:
        """The local vertices of the geometry in the set, or of the tagged entities."""
        if self.entities is None or self.dim is None:
            return np.flatnonzero(self.vertices)
        return _nodes(msh, self.dim, self.entities).ravel()


def select(msh: Mesh[np.float64], groups: Mapping[str | int, Group], where: Where) -> Selection:
    """Find what meets a clause. Collective.

    Raises:
        MeshError: Nothing does on any rank, or the clause names an axis, vertex or tag that the
            mesh does not have.
    """
    low, high = _extents(msh)
    chosen = _in_place(msh, where, low, high)
    numbers = msh.geometry.input_global_indices
    if where.vertices is not None:
        size = msh.geometry.index_map().size_global
        if max(where.vertices) >= size:
            raise MeshError(
                f"{where}: vertex {max(where.vertices)} is out of range; the mesh has vertices "
                f"0 to {size - 1}"
            )
        chosen &= np.isin(numbers, where.vertices)
    found = Selection(chosen, listed=where.vertices is not None)
    if where.tag is not None:
        dim, members = tagged(groups, where, msh.topology.dim)
        if dim == 0:
            chosen &= np.isin(numbers, members)
            found = Selection(chosen, listed=True)
        else:
            entities = _carriers(msh, dim, members)
            inside = chosen[_nodes(msh, dim, entities)].all(axis=1)
            found = Selection(chosen, dim, entities[inside])
    count = chosen.sum() if found.entities is None else len(found.entities)
    if msh.comm.allreduce(int(count)) == 0:
        spans = ", ".join(
            f"{axis} from {a:g} to {b:g}" for axis, a, b in zip(AXES, low, high, strict=False)
        )
        noun = "vertex" if found.entities is None else "entity"
        raise MeshError(f"{where} holds no {noun}; the mesh spans {spans}")
    return found


def tagged(groups: Mapping[str | int, Group], where: Where, d: int) -> tuple[int, Integers]:
    """Dimension and members of the group that a clause names, as a part of the boundary.

    Raises:
        MeshError: There is none. Cells count by name only: by number they are a mistake.
    """
    group = groups.get(where.tag) if where.tag is not None else None
    dim = None if group is None else group.boundary(d)
    if group is not None and dim is None and isinstance(where.tag, str):
        dim = d
    if group is None or dim is None:
        known = ", ".join(
            str(tag)
            for tag, g in groups.items()
            if isinstance(tag, str) or g.boundary(d) is not None
        )
        raise MeshError(f"{where}: the mesh has no such tag; tags: {known or 'none'}")
    return dim, group.entities[dim]


def skin(msh: Mesh[np.float64], found: Selection) -> npt.NDArray[np.int32] | None:
    """The facets that listed vertices are meant for, if they are all on the boundary. Collective.

    Where two sides meet, an edge between their vertices may go through the inside of the body, so
    that having all its vertices in the set does not put it on either side.

    Returns:
        The facets of the boundary with all vertices in the set, of those this rank owns. None if
        the set is another: not listed, not on the boundary alone, or without a whole facet.
    """
    if not found.listed:
        return None
    d = msh.topology.dim
    _every(msh, d - 1)
    msh.topology.create_connectivity(d - 1, d)
    boundary = exterior_facet_indices(msh.topology)
    nodes = _nodes(msh, d - 1, boundary)
    outside = _marked(msh.geometry.index_map(), nodes.ravel())
    facets = boundary[found.vertices[nodes].all(axis=1)]
    within = int((found.vertices & ~outside).sum())
    whole = msh.comm.allreduce(np.array([within, len(facets)]))
    return np.asarray(facets) if whole[0] == 0 and whole[1] > 0 else None


def agreed(V: FunctionSpace[Any], blocks: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Blocks of degrees of freedom that any rank has found, as this rank numbers them. Collective.

    A tagged entity may lie in the cells of one rank alone, and its vertices in those of others.
    """
    return np.flatnonzero(_marked(V.dofmap.index_map, blocks)).astype(np.int32)


def _marked(index_map: IndexMap, chosen: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Whether any rank has chosen each of the indices that this rank has. Collective."""
    mark = la.vector(index_map, 1, dtype=np.int32)
    mark.array[:] = 0
    mark.array[chosen] = 1
    mark.scatter_reverse(la.InsertMode.add)
    mark.scatter_forward()
    return np.asarray(mark.array > 0)


def _extents(msh: Mesh[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    x = msh.geometry.x[:, : msh.geometry.dim]
    low = np.min(msh.comm.allgather(x.min(axis=0, initial=np.inf)), axis=0)
    high = np.max(msh.comm.allgather(x.max(axis=0, initial=-np.inf)), axis=0)
    return low, high


def _in_place(
    msh: Mesh[np.float64],
    where: Where,
    low: npt.NDArray[np.float64],
    high: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    """Whether each local vertex is where the clause wants it."""
    d = msh.geometry.dim
    x = msh.geometry.x[:, :d]
    largest = np.maximum(np.abs(low), np.abs(high)).max()
    wide = max(PLANE_TOLERANCE * float((high - low).max()), _ROUNDING * largest)
    chosen = np.ones(len(x), dtype=np.bool_)
    for axis, extent in where.extents:
        i = AXES.index(axis)
        if i >= d:
            raise MeshError(f"{where}: the mesh is {d}D and has no {axis} axis")
        if isinstance(extent, str):
            first = last = {"min": low, "max": high}[extent][i]
        else:
            first, last = extent
        tolerance = min(wide, _THINNEST * (high[i] - low[i]))
        chosen &= (x[:, i] >= first - tolerance) & (x[:, i] <= last + tolerance)
    return chosen


def _every(msh: Mesh[np.float64], dim: int) -> npt.NDArray[np.int32]:
    """All local entities of a dimension, ghosts included."""
    msh.topology.create_entities(dim)
    entities = msh.topology.index_map(dim)
    return np.arange(entities.size_local + entities.num_ghosts, dtype=np.int32)


def _nodes(
    msh: Mesh[np.float64], dim: int, entities: npt.NDArray[np.int32]
) -> npt.NDArray[np.int32]:
    """The vertices of entities, numbered as in the geometry. Shape (entities, vertices of one)."""
    msh.topology.create_entities(dim)
    msh.topology.create_connectivity(dim, msh.topology.dim)
    return entities_to_geometry(msh, dim, entities)


def _carriers(msh: Mesh[np.float64], dim: int, members: Integers) -> npt.NDArray[np.int32]:
    """The local entities that a group lists by their file numbers, or those of their vertices."""
    if dim == msh.topology.dim:
        found = np.isin(msh.topology.original_cell_index, members)
        return np.flatnonzero(found).astype(np.int32)
    every = _every(msh, dim)
    numbers, nodes = msh.geometry.input_global_indices, _nodes(msh, dim, every)
    # Few entities have all their vertices among those of the group and are not of it.
    near = np.flatnonzero(np.isin(numbers, members)[nodes].all(axis=1))
    rows = np.sort(numbers[nodes[near]], axis=1)
    wanted = np.unique(np.sort(members, axis=1), axis=0)
    _, place = np.unique(np.concatenate([wanted, rows]), axis=0, return_inverse=True)
    place = place.ravel()
    return every[near[np.isin(place[len(wanted) :], place[: len(wanted)])]]


def vertex_blocks(
    V: FunctionSpace[Any],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Pairs of a block of degrees of freedom and its vertex, cell by cell with repetitions.

    Args:
        V: A continuous Lagrange space.
    """
    element = V.element.basix_element
    if element.discontinuous or element.degree < 1:
        raise ValueError("expected a continuous Lagrange space on the body's mesh")
    nodes = V.mesh.geometry.dofmaps[0]
    # Both layouts list the vertices of a cell in the same order, so cells pair them.
    layout = V.dofmap.dof_layout
    corners = [layout.entity_dofs(0, vertex)[0] for vertex in range(nodes.shape[1])]
    return V.dofmap.list[:, corners].ravel(), nodes.ravel()
