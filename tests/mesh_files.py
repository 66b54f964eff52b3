"""Mesh files for tests, and bodies in the order of their files."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
from dolfinx import fem
from dolfinx.mesh import entities_to_geometry

from meshes import CELLS, Body, Where, box

COMM = MPI.COMM_WORLD
BOX16 = Path(__file__).parents[2] / "shared" / "reference" / "box16.mesh"

# Two tetrahedra over a square base (vertices 1 to 4) with the tip listed first, in an order
# that is neither spatial nor DOLFINx's own.
TIP = np.array([[0.2, 0.3, 1.0], [1, 1, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
TETRAHEDRA = np.array([[0, 2, 1, 4], [3, 0, 1, 2]])
BASE = np.array([[1, 2, 3], [1, 2, 4]])


def write(path: Path, points, cells, **kwargs) -> Path:
    """Write a mesh file on rank 0."""
    if COMM.rank == 0:
        file_format = kwargs.pop("file_format", None)
        options = {key: kwargs.pop(key) for key in ("binary",) if key in kwargs}
        mesh = meshio.Mesh(np.asarray(points, dtype=float), cells, **kwargs)
        mesh.write(path, file_format, **options)
    COMM.barrier()
    return path


def p1(body: Body) -> fem.FunctionSpace:
    """The space of positions."""
    return fem.functionspace(body.mesh, ("Lagrange", 1, (body.mesh.geometry.dim,)))


def vertices(body: Body, clause: dict) -> list[int]:
    """File numbers of a vertex set, over all ranks; ghosts must agree with their owners."""
    V = p1(body)
    dofs = body.dofs(V, Where.parse(clause))
    assert (np.diff(dofs) > 0).all()
    mark = fem.Function(V)
    mark.x.array.reshape(-1, V.dofmap.index_map_bs)[dofs] = 1
    marked = mark.x.array.copy()
    mark.x.scatter_forward()
    np.testing.assert_array_equal(mark.x.array, marked)
    owned = dofs[dofs < V.dofmap.index_map.size_local]
    return sorted(np.concatenate(COMM.allgather(body.file_vertices(V)[owned])).tolist())


def in_file_order(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, cells (vertices sorted) and cell tags, over all ranks, by file number."""
    V = p1(body)
    x = fem.Function(V)
    x.interpolate(lambda X: X[: body.mesh.geometry.dim])
    exact = body.gather_points(everywhere=True)
    np.testing.assert_allclose(body.gather(x, everywhere=True), exact, atol=1e-14)
    cells = body.gather(np.sort(body.file_connectivity()), everywhere=True)
    tags = body.gather(body.cell_tags.values[: len(body.file_cells)], everywhere=True)
    return exact, cells, tags


def put_text(path: Path, text: str) -> Path:
    """Write a text file on rank 0."""
    if COMM.rank == 0:
        path.write_text(text)
    COMM.barrier()
    return path


# The two tetrahedra of TIP, tagged.
TAGS = [4, 9]


def check_tip(body: Body, tags=TAGS) -> None:
    """The body is that of TIP."""
    points, cells, found = in_file_order(body)
    np.testing.assert_array_equal(points, TIP)
    np.testing.assert_array_equal(cells, np.sort(TETRAHEDRA))
    np.testing.assert_array_equal(found, tags)


def cells_of(body: Body, tag) -> np.ndarray:
    """File numbers of all cells with a tag."""
    cells = body.cells(tag)
    mine = body.file_cells[cells[cells < len(body.file_cells)]]
    return np.sort(np.concatenate(COMM.allgather(mine))).tolist()


def rows(table, first: int = 0, sep: str = " ") -> str:
    """Rows of numbers, counted from `first` if that is not 0."""
    lines = []
    for k, row in enumerate(np.asarray(table).tolist()):
        words = [str(w) for w in row]
        lines.append(sep.join([str(k + first), *words] if first else words))
    return "\n".join(lines) + "\n"


# meshio's names of the cells and of their facets.
MEDIT = {
    "triangle": ("triangle", "line"),
    "quadrilateral": ("quad", "line"),
    "tetrahedron": ("tetra", "triangle"),
    "hexahedron": ("hexahedron", "quad"),
}
VTK = {"quadrilateral": [0, 1, 3, 2], "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6]}
SIZE, COUNT = (2.0, 1.5, 1.0), (4, 3, 2)


def sides_file(path, cell: str, inner: bool = False):
    """A box whose facets on x = 0 and y = 1.5 are tagged 3, those on x = 2 tagged 6.

    With `inner` all other facets are listed too, without a tag. The cells with x < 1 are tagged 8.
    """
    d = 2 if cell in CELLS[2] else 3
    body = box(MPI.COMM_SELF, SIZE[:d], COUNT[:d], cell)
    body.mesh.topology.create_entities(d - 1)
    body.mesh.topology.create_connectivity(d - 1, d)
    count = body.mesh.topology.index_map(d - 1).size_local
    nodes = entities_to_geometry(body.mesh, d - 1, np.arange(count, dtype=np.int32))
    facets = body.mesh.geometry.input_global_indices[nodes]
    if cell == "hexahedron":
        facets = facets[:, VTK["quadrilateral"]]
    points = body.gather_points()
    x, y = points[facets][..., 0], points[facets][..., 1]
    tags = np.where((x == 0).all(axis=1) | (y == SIZE[1]).all(axis=1), 3, 0)
    tags = np.where((x == SIZE[0]).all(axis=1), 6, tags)
    listed = np.ones(count, dtype=bool) if inner else tags != 0
    cells = body.gather(body.file_connectivity())
    if cell in VTK:
        cells = cells[:, VTK[cell]]
    regions = np.where(points[cells].mean(axis=1)[:, 0] < 1.0, 8, 0)
    kind, facet = MEDIT[cell]
    return write(
        path,
        points,
        [(kind, cells), (facet, facets[listed])],
        cell_data={"medit:ref": [regions, tags[listed]]},
    )
