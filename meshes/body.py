"""A body: a mesh, its tags, and the order of the file it came from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.fem import (
    Function,
    FunctionSpace,
    IntegralType,
    compute_integration_domains,
    functionspace,
    locate_dofs_topological,
)
from dolfinx.mesh import (
    CellType,
    Mesh,
    MeshTags,
    exterior_facet_indices,
    meshtags,
)

from meshes import selection
from meshes.errors import MeshError
from meshes.groups import Group, Integers
from meshes.where import Where

# Vertices of a cell in the order of VTK, which goes around a face, among DOLFINx's, which goes
# through a grid; and the other way round.
VTK_ORDER = {
    CellType.triangle: [0, 1, 2],
    CellType.quadrilateral: [0, 1, 3, 2],
    CellType.tetrahedron: [0, 1, 2, 3],
    CellType.hexahedron: [0, 1, 3, 2, 4, 5, 7, 6],
}

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class _Measured:
    """What a kind of measure is over, by number. One list serves all, as DOLFINx wants."""

    domains: list[tuple[int, Array]] = field(default_factory=list)
    numbers: dict[Where | None, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """A mesh in d = 2 or 3 dimensions, distributed with one ghost layer.

    "File order" is the order of vertices and cells in the mesh file, or for a generated body
    the order documented by its generator; both count from 0.

    Attributes:
        mesh: The distributed mesh, in metres, with its facet neighbours as ghost cells.
        cell_tags: A tag for each local cell, ghosts included; 0 where the file gives none, and the
            first that it gives where there are several.
        groups: Tagged entities by name and by number, the same on all ranks.
    """

    mesh: Mesh[np.float64]
    cell_tags: MeshTags
    groups: Mapping[str | int, Group] = field(default_factory=dict)
    _facets: _Measured = field(default_factory=_Measured, init=False, repr=False)
    _vertices: _Measured = field(default_factory=_Measured, init=False, repr=False)

    @property
    def num_vertices(self) -> int:
        """Number of vertices over all ranks."""
        return int(self.mesh.geometry.index_map().size_global)

    @property
    def num_cells(self) -> int:
        """Number of cells over all ranks."""
        return int(self.mesh.topology.index_map(self.mesh.topology.dim).size_global)

    @property
    def file_cells(self) -> Integers:
        """File number of each cell this rank owns, shape (owned cells,)."""
        owned = self.mesh.topology.index_map(self.mesh.topology.dim).size_local
        return np.asarray(self.mesh.topology.original_cell_index[:owned])

    def file_connectivity(self) -> Integers:
        """File vertex numbers of the cells this rank owns, shape (owned cells, vertices a cell)."""
        owned = len(self.file_cells)
        geometry = self.mesh.geometry
        return np.asarray(geometry.input_global_indices[geometry.dofmaps[0][:owned]])

    def file_vertices(self, V: FunctionSpace[np.float64]) -> Integers:
        """File number of the vertex of each local block of degrees of freedom.

        Args:
            V: A continuous piecewise linear space on this mesh, of any value shape.

        Returns:
            Shape (owned + ghost blocks,).

        Raises:
            ValueError: The space has other degrees of freedom than one block a vertex.
        """
        element = V.element.basix_element
        if element.discontinuous or element.degree != 1:
            raise ValueError("expected a continuous piecewise linear space on the body's mesh")
        blocks, nodes = selection.vertex_blocks(V)
        numbers = np.empty(len(self.mesh.geometry.x), dtype=np.int64)
        numbers[blocks] = self.mesh.geometry.input_global_indices[nodes]
        return numbers

    def file_blocks(self, V: FunctionSpace[Any]) -> Integers:
        """File number of the vertex or cell of each local block of degrees of freedom.

        Args:
            V: As `file_vertices`, or of functions that are constant on each cell.

        Returns:
            Shape (owned + ghost blocks,).
        """
        if V.element.basix_element.degree > 0:
            return self.file_vertices(V)
        numbers = np.empty(len(V.dofmap.list), dtype=np.int64)
        numbers[V.dofmap.list[:, 0]] = self.mesh.topology.original_cell_index
        return numbers

    def gather(self, f: Function[Any] | Array, *, everywhere: bool = False) -> Array | None:
        """Values at all vertices or in all cells, in file order. Collective.

        Args:
            f: A Lagrange function of any degree, of which the values at the vertices are meant; a
                function that is constant on each cell; or an array with a row for each cell this
                rank owns, in the order of `file_cells`.
            everywhere: Whether all ranks get the values, or rank 0 alone.

        Returns:
            Shape (vertices or cells, *shape of a value), of a symmetric tensor (…, components).
            None on ranks that get nothing.

        Raises:
            ValueError: A function of another kind.
        """
        if isinstance(f, np.ndarray):
            return self._collect(self.file_cells, f, self.num_cells, everywhere)
        V = f.function_space
        index_map, bs = V.dofmap.index_map, V.dofmap.index_map_bs
        rows = f.x.array.reshape(-1, bs)
        shape = f.ufl_shape if int(np.prod(f.ufl_shape)) == bs else (bs,)
        if V.element.basix_element.degree == 0:
            blocks = V.dofmap.list[: len(self.file_cells), 0]
            values = rows[blocks].reshape(-1, *shape)
            return self._collect(self.file_cells, values, self.num_cells, everywhere)
        blocks, nodes = selection.vertex_blocks(V)
        owned = blocks < index_map.size_local
        blocks, first = np.unique(blocks[owned], return_index=True)
        numbers = self.mesh.geometry.input_global_indices[nodes[owned][first]]
        values = rows[blocks].reshape(-1, *shape)
        return self._collect(numbers, values, self.num_vertices, everywhere)

    def gather_points(self, *, everywhere: bool = False) -> Array | None:
        """Positions of all vertices at rest [m], in file order. Collective.

        Returns:
            Shape (vertices, d); None on ranks that get nothing.
        """
        geometry = self.mesh.geometry
        owned = geometry.index_map().size_local
        numbers, x = geometry.input_global_indices[:owned], geometry.x[:owned, : geometry.dim]
        return self._collect(numbers, x, self.num_vertices, everywhere)

    def put(self, f: Function[Any], values: npt.ArrayLike) -> None:
        """Set a function from its values at all vertices or in all cells, in file order.

        Args:
            f: Continuous and piecewise linear, or constant on each cell.
            values: Of any shape with as many entries as the function has; the same on all ranks.

        Raises:
            ValueError: A function of another kind, or another number of values.
        """
        V = f.function_space
        bs, size = V.dofmap.index_map_bs, V.dofmap.index_map.size_global
        numbers = self.file_blocks(V)
        values = np.asarray(values)
        if values.size != size * bs:
            raise ValueError(
                f"{values.size} values are given for {f.name}; it has {bs} at each of {size} places"
            )
        f.x.array[:] = values.reshape(size, bs)[numbers].ravel()

    def dofs(self, V: FunctionSpace[np.float64], where: Where) -> npt.NDArray[np.int32]:
        """Degrees of freedom of a part of the body, for `dolfinx.fem.dirichletbc`.

        With a tag of facets, edges or (by name) cells they are those on the tagged entities alone.
        With vertices they are those at the vertices, and inside an edge, face or cell all of whose
        vertices are in the set; but if the vertices are listed, by number or tag, and all on the
        boundary, only inside facets of the boundary and their edges.

        Collective. Ghosts are included and agree with their owners.

        Args:
            V: A Lagrange space on this mesh, of any degree and value shape.
            where: The part.

        Returns:
            Sorted local block indices; empty on a rank that holds none of them.

        Raises:
            MeshError: Nothing at all meets the clause, or it names an axis, vertex or tag that this
                body does not have.
        """
        found = selection.select(self.mesh, self.groups, where)
        d = self.mesh.topology.dim
        if found.dim is None and V.element.basix_element.degree == 1:
            blocks, nodes = selection.vertex_blocks(V)
            return np.unique(blocks[found.vertices[nodes]]).astype(np.int32)
        facets = selection.skin(self.mesh, found)
        if found.dim is not None:
            parts = {found.dim: found.local(self.mesh, found.dim)}
        elif facets is not None:
            parts = {0: found.local(self.mesh, 0), d - 1: facets}
        else:
            parts = {dim: found.local(self.mesh, dim) for dim in range(d + 1)}
        dofs = [np.empty(0, dtype=np.int32)]
        for dim, entities in parts.items():
            self.mesh.topology.create_connectivity(dim, d)
            dofs.append(locate_dofs_topological(V, dim, entities, remote=False))
        return selection.agreed(V, np.unique(np.concatenate(dofs)).astype(np.int32))

    def cells(self, tag: str | int) -> npt.NDArray[np.int32]:
        """The local cells with a tag, ghosts included.

        Args:
            tag: A name or number of a group of cells, or a number among `cell_tags`.

        Returns:
            Sorted local indices, empty on a rank that has none.
        """
        group = self.groups.get(tag)
        members = None if group is None else group.entities.get(self.mesh.topology.dim)
        if members is None:
            return self.cell_tags.find(tag) if isinstance(tag, int) else np.empty(0, np.int32)
        numbers = self.mesh.topology.original_cell_index
        return np.flatnonzero(np.isin(numbers, members)).astype(np.int32)

    def tagged_cells(self) -> list[str | int]:
        """The numbers, sorted, and the names that tag cells. Collective."""
        found = self.mesh.comm.allgather(set(self.cell_tags.values.tolist()))
        of_cells = [tag for tag, g in self.groups.items() if self.mesh.topology.dim in g.entities]
        numbers = set.union(*found, (tag for tag in of_cells if isinstance(tag, int)))
        return [*sorted(numbers), *(tag for tag in of_cells if isinstance(tag, str))]

    def regions(self, tags: Sequence[str | int]) -> MeshTags:
        """Number the cells by which of some tags they have, for `forms.by_tag`. Collective.

        Args:
            tags: Names or numbers of groups of cells.

        Returns:
            For each local cell, ghosts included, the place of its tag among `tags`.

        Raises:
            MeshError: A cell has none of the tags or two of them, or no cell has one of them.
        """
        comm, numbers = self.mesh.comm, self.mesh.topology.original_cell_index
        places = np.full(len(numbers), -1, dtype=np.int32)
        problems: list[tuple[int, str]] = []  # the first cell of the file that has one
        for place, tag in enumerate(tags):
            cells = self.cells(tag)
            if comm.allreduce(len(cells)) == 0:
                raise MeshError(f"no cell is tagged {tag}")
            twice = cells[places[cells] >= 0]
            if len(twice):
                first = twice[numbers[twice].argmin()]
                other = tags[int(places[first])]
                problems.append((int(numbers[first]), f"both {other} and {tag}"))
            places[cells] = place
        bare = numbers[places < 0]
        if len(bare):
            problems.append((int(bare.min()), f"none of {', '.join(map(str, tags))}"))
        problems = [p for parts in comm.allgather(problems) for p in parts]
        if problems:
            cell, said = min(problems)
            raise MeshError(f"cell {cell} (from 0) is tagged {said}")
        local = np.arange(len(places), dtype=np.int32)
        return meshtags(self.mesh, self.mesh.topology.dim, local, places)

    def facets(self, where: Where | None = None) -> npt.NDArray[np.int32]:
        """The facets of the boundary in a part of the body, of those this rank owns. Collective.

        They carry the tag, or, with a tag of cells, belong to such a cell; without a tag, and with
        a tag of vertices, all their vertices are in the set.

        Args:
            where: The part; by default the whole boundary.

        Returns:
            Sorted local indices, empty on a rank that has none.

        Raises:
            MeshError: There are none on any rank, or as `dofs`.
        """
        msh = self.mesh
        d = msh.topology.dim
        msh.topology.create_entities(d - 1)
        msh.topology.create_connectivity(d - 1, d)
        chosen = exterior_facet_indices(msh.topology)
        if where is None:
            return np.asarray(chosen)
        found = selection.select(msh, self.groups, where)
        if found.dim == d:
            cells = msh.topology.connectivity(d - 1, d)
            of_facets = cells.array[cells.offsets[chosen]]  # one each, being of the boundary
            chosen = chosen[np.isin(of_facets, found.local(msh, d))]
        elif found.dim in (None, d - 1):
            chosen = np.intersect1d(chosen, found.local(msh, d - 1))
        else:
            raise MeshError(f"{where}: the tag is on edges, and facets are wanted here")
        if msh.comm.allreduce(len(chosen)) == 0:
            raise MeshError(f"{where} holds no facet of the boundary")
        return np.asarray(chosen)

    def ds(self, where: Where | None = None) -> ufl.Measure:
        """The measure over the facets of the boundary in a part of the body. Collective.

        For tractions and pressures: ``inner(traction, u) * body.ds(Where(tag="top"))``. Measures of
        several parts may stand in one form, whether or not they overlap, but none of them beside a
        plain `ufl.ds`, which has no facets of its own for DOLFINx; take `body.ds()` for it.

        Args:
            where: The part, see `facets`; by default the whole boundary.

        Raises:
            MeshError: As `facets`.
        """
        return self._measure("ds", self._facets, where, self._facet_domain)

    def dP(self, where: Where) -> ufl.Measure:
        """The measure that sums over the vertices in a part of the body, each once. Collective.

        For forces at points: ``inner(force, u) * body.dP(Where(vertices=(7,)))``.
        Measures of several parts may stand in one form.

        Args:
            where: The part, see `dofs`.

        Raises:
            MeshError: As `dofs`.
        """
        return self._measure("dP", self._vertices, where, self._vertex_domain)

    def _measure[W: Where | None](
        self, kind: str, measured: _Measured, where: W, domain: Callable[[W], Array]
    ) -> ufl.Measure:
        if where not in measured.numbers:
            entities = domain(where)
            measured.numbers[where] = len(measured.domains) + 1
            measured.domains.append((measured.numbers[where], entities))
        return ufl.Measure(
            kind,
            self.mesh,
            subdomain_data=measured.domains,
            subdomain_id=measured.numbers[where],
        )

    def _facet_domain(self, where: Where | None) -> Array:
        """Pairs of a cell and which of its facets."""
        facets = self.facets(where)
        domain = compute_integration_domains(
            IntegralType.exterior_facet, self.mesh.topology, facets
        )
        return np.asarray(domain)

    def _vertex_domain(self, where: Where) -> Array:
        """Pairs of a cell and which of its vertices, one for each that this rank owns."""
        V = functionspace(self.mesh, ("P", 1))
        chosen = self.dofs(V, where)
        chosen = chosen[chosen < V.dofmap.index_map.size_local]
        blocks, _ = selection.vertex_blocks(V)
        found, first = np.unique(blocks, return_index=True)
        cells, vertices = np.divmod(first[np.isin(found, chosen)], V.dofmap.list.shape[1])
        return np.stack([cells, vertices], axis=1).astype(np.int32).ravel()

    def _collect(self, numbers: Integers, rows: Array, size: int, everywhere: bool) -> Array | None:
        """Put rows that the ranks own in their places in the file."""
        comm = self.mesh.comm
        part = (numbers, rows)
        parts = comm.allgather(part) if everywhere else comm.gather(part)
        if parts is None:
            return None
        whole = np.empty((size, *rows.shape[1:]), dtype=rows.dtype)
        for places, values in parts:
            whole[places] = values
        return whole
