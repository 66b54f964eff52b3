"""A body: a mesh, its tags, and the order of the file it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from dolfinx.fem import FunctionSpace, locate_dofs_topological
from dolfinx.mesh import CellType, Mesh, MeshTags, entities_to_geometry

from meshes.where import AXES, Where

# Vertices count as lying on a plane within this fraction of the largest extent: single
# precision files round coordinates at 1e-7.
PLANE_TOLERANCE = 1e-6

# Vertices of a cell in the order of VTK, which goes around a face, among DOLFINx's, which goes
# through a grid; and the other way round.
VTK_ORDER = {
    CellType.triangle: [0, 1, 2],
    CellType.quadrilateral: [0, 1, 3, 2],
    CellType.tetrahedron: [0, 1, 2, 3],
    CellType.hexahedron: [0, 1, 3, 2, 4, 5, 7, 6],
}


class MeshError(ValueError):
    """A mesh, or a set of its vertices, cannot be used; the message is one line."""


@dataclass(frozen=True)
class Body:
    """A mesh in d = 2 or 3 dimensions, distributed with one ghost layer.

    "File order" is the order of vertices and cells in the mesh file, or for a generated body
    the order documented by its generator; both count from 0.

    Attributes:
        mesh: The distributed mesh, in metres, with its facet neighbours as ghost cells.
        cell_tags: A tag for each local cell, ghosts included; 0 where the file gives none.
        groups: Vertices (file order, sorted) of each tagged set, by name and by number.
    """

    mesh: Mesh[np.float64]
    cell_tags: MeshTags
    groups: Mapping[str | int, npt.NDArray[np.int64]] = field(default_factory=dict)

    @property
    def num_vertices(self) -> int:
        """Number of vertices over all ranks."""
        return int(self.mesh.geometry.index_map().size_global)

    @property
    def num_cells(self) -> int:
        """Number of cells over all ranks."""
        return int(self.mesh.topology.index_map(self.mesh.topology.dim).size_global)

    @property
    def file_cells(self) -> npt.NDArray[np.int64]:
        """File number of each cell this rank owns, shape (owned cells,)."""
        owned = self.mesh.topology.index_map(self.mesh.topology.dim).size_local
        return np.asarray(self.mesh.topology.original_cell_index[:owned])

    def file_connectivity(self) -> npt.NDArray[np.int64]:
        """File vertex numbers of the cells this rank owns, shape (owned cells, vertices a cell)."""
        owned = len(self.file_cells)
        geometry = self.mesh.geometry
        return np.asarray(geometry.input_global_indices[geometry.dofmaps[0][:owned]])

    def file_vertices(self, V: FunctionSpace[np.float64]) -> npt.NDArray[np.int64]:
        """File number of the vertex of each local block of degrees of freedom.

        Args:
            V: A continuous piecewise linear space on this mesh, of any value shape.

        Returns:
            Shape (owned + ghost blocks,).

        Raises:
            ValueError: The space has other degrees of freedom than one block a vertex.
        """
        return np.asarray(self.mesh.geometry.input_global_indices[self._nodes(V)])

    def dofs(self, V: FunctionSpace[np.float64], where: Where) -> npt.NDArray[np.int32]:
        """Degrees of freedom at the vertices of a set, for `dolfinx.fem.dirichletbc`.

        Those inside an edge, face or cell count if all its vertices are in the set.

        Collective. Ghosts are included and agree with their owners.

        Args:
            V: A Lagrange space on this mesh, of any degree and value shape.
            where: The set.

        Returns:
            Sorted local block indices; empty on a rank that holds none of the vertices.

        Raises:
            MeshError: No vertex at all meets the clause, or it names an axis, vertex or tag
                that this body does not have.
        """
        chosen = self._select(where)
        if V.element.basix_element.degree == 1:
            return np.flatnonzero(chosen[self._nodes(V)]).astype(np.int32)
        found = []
        for dim in range(self.mesh.topology.dim + 1):
            self.mesh.topology.create_entities(dim)
            self.mesh.topology.create_connectivity(dim, self.mesh.topology.dim)
            entities = self.mesh.topology.index_map(dim)
            every = np.arange(entities.size_local + entities.num_ghosts, dtype=np.int32)
            nodes = entities_to_geometry(self.mesh, dim, every)
            inside = every[chosen[nodes].all(axis=1)]
            found.append(locate_dofs_topological(V, dim, inside))
        return np.unique(np.concatenate(found)).astype(np.int32)

    def _nodes(self, V: FunctionSpace[np.float64]) -> npt.NDArray[np.int32]:
        # Both layouts list the vertices of a cell in the same order, so cells pair them.
        blocks, nodes = V.dofmap.list, self.mesh.geometry.dofmaps[0]
        index_map = V.dofmap.index_map
        size = index_map.size_local + index_map.num_ghosts
        if blocks.shape != nodes.shape or size != len(self.mesh.geometry.x):
            raise ValueError("expected a continuous piecewise linear space on the body's mesh")
        node = np.empty(size, dtype=np.int32)
        node[blocks.ravel()] = nodes.ravel()
        return node

    def _select(self, where: Where) -> npt.NDArray[np.bool_]:
        geometry = self.mesh.geometry
        comm = self.mesh.comm
        x = geometry.x[:, : geometry.dim]
        low = np.min(comm.allgather(x.min(axis=0, initial=np.inf)), axis=0)
        high = np.max(comm.allgather(x.max(axis=0, initial=-np.inf)), axis=0)
        tolerance = PLANE_TOLERANCE * float((high - low).max())

        chosen = np.ones(len(x), dtype=np.bool_)
        for axis, extent in where.extents:
            i = AXES.index(axis)
            if i >= geometry.dim:
                raise MeshError(f"{where}: the mesh is {geometry.dim}D and has no {axis} axis")
            if isinstance(extent, str):
                first = last = {"min": low, "max": high}[extent][i]
            else:
                first, last = extent
            chosen &= (x[:, i] >= first - tolerance) & (x[:, i] <= last + tolerance)
        numbers = geometry.input_global_indices
        if where.vertices is not None:
            if max(where.vertices) >= self.num_vertices:
                raise MeshError(
                    f"{where}: vertex {max(where.vertices)} is out of range; the mesh has vertices "
                    f"0 to {self.num_vertices - 1}"
                )
            chosen &= np.isin(numbers, where.vertices)
        if where.tag is not None:
            if where.tag not in self.groups:
                known = ", ".join(str(tag) for tag in self.groups) or "none"
                raise MeshError(f"{where}: the mesh has no such tag; tags: {known}")
            chosen &= np.isin(numbers, self.groups[where.tag])
        if comm.allreduce(int(chosen.sum())) == 0:
            spans = ", ".join(
                f"{axis} from {a:g} to {b:g}" for axis, a, b in zip(AXES, low, high, strict=False)
            )
            raise MeshError(f"{where} holds no vertex; the mesh spans {spans}")
        return chosen
