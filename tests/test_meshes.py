"""Meshes: file order on any number of ranks, tags, vertex sets, and what is refused."""

from __future__ import annotations

from itertools import product
from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.io import XDMFFile
from dolfinx.mesh import compute_midpoints, entities_to_geometry, locate_entities_boundary, meshtags

from meshes import CELLS, Body, MeshError, Where, box, read

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
    owned = V.dofmap.index_map.size_local
    number = np.concatenate(COMM.allgather(body.file_vertices(V)[:owned]))
    x = np.concatenate(COMM.allgather(V.tabulate_dof_coordinates()[:owned]))
    geometry = body.mesh.geometry
    owned = geometry.index_map().size_local
    exact = np.concatenate(COMM.allgather(geometry.x[:owned]))
    nodes = np.concatenate(COMM.allgather(geometry.input_global_indices[:owned]))
    cell = np.concatenate(COMM.allgather(body.file_cells))
    cells = np.concatenate(COMM.allgather(body.file_connectivity()))
    tags = np.concatenate(COMM.allgather(body.cell_tags.values[: len(body.file_cells)]))
    np.testing.assert_array_equal(np.sort(number), np.arange(body.num_vertices))
    np.testing.assert_array_equal(np.sort(cell), np.arange(body.num_cells))
    exact = exact[np.argsort(nodes), : geometry.dim]
    # dof coordinates are pushed forward from the reference cell, so equal to round-off only
    np.testing.assert_allclose(x[np.argsort(number), : geometry.dim], exact, atol=1e-14)
    return exact, np.sort(cells[np.argsort(cell)]), tags[np.argsort(cell)]


@pytest.mark.parametrize(
    ("cells", "cell", "per_cell"),
    [
        ((3, 2), "triangle", 2),
        ((3, 2), "quadrilateral", 1),
        ((3, 2, 4), None, 6),
        ((3, 2, 4), "hexahedron", 1),
    ],
)
def test_box_lists_its_vertices_and_cells_x_first(cells, cell, per_cell):
    """The documented order, on any number of ranks; with quadrilaterals y is first."""
    turn = slice(None) if cell == "quadrilateral" else slice(None, None, -1)
    size = (0.3, 2.0, 1.0)[: len(cells)]
    points, parts, _ = in_file_order(box(COMM, size, cells, cell))
    grid = [np.linspace(0, s, n + 1) for s, n in zip(size, cells, strict=True)]
    expected = [position[turn] for position in product(*grid[turn])]
    np.testing.assert_allclose(points, expected, atol=1e-14)
    centres = points[parts].mean(axis=1).reshape(-1, per_cell, len(cells)).mean(axis=1)
    middles = [0.5 * (g[1:] + g[:-1]) for g in grid]
    expected = [position[turn] for position in product(*middles[turn])]
    np.testing.assert_allclose(centres, expected, atol=1e-14)


def test_box_repeats_the_reference_mesh():
    """The reference bar is our box with its vertices in another order."""
    if not BOX16.exists():
        pytest.skip(f"{BOX16} is absent")
    ours, our_cells, _ = in_file_order(box(COMM, (1.0, 0.25, 0.25), (16, 4, 4)))
    theirs, their_cells, _ = in_file_order(read(COMM, BOX16))
    # z runs fastest there
    number = np.arange(len(ours)).reshape(5, 5, 17).transpose(2, 1, 0).ravel()
    np.testing.assert_array_equal(theirs, ours[number])
    renumbered = np.sort(number[their_cells])
    assert {tuple(c) for c in renumbered} == {tuple(c) for c in our_cells}


def test_reads_the_reference_mesh_in_its_own_order():
    """Vertices and cells as the Medit file lists them."""
    if not BOX16.exists():
        pytest.skip(f"{BOX16} is absent")
    words = BOX16.read_text().split()
    at = words.index("Vertices")
    expected = np.array(words[at + 2 : at + 2 + 425 * 4], dtype=float).reshape(425, 4)[:, :3]
    at = words.index("Tetrahedra")
    cells = np.array(words[at + 2 : at + 2 + 1536 * 5], dtype=int).reshape(1536, 5)[:, :4] - 1
    body = read(COMM, BOX16)
    points, found, tags = in_file_order(body)
    np.testing.assert_array_equal(points, expected)
    np.testing.assert_array_equal(found, np.sort(cells))
    assert not tags.any()
    assert vertices(body, {"x": "max"}) == list(range(400, 425))


FORMATS = {
    "medit": ("tip.mesh", {}, "medit:ref"),
    "gmsh 2.2": ("tip.msh", {"file_format": "gmsh22"}, "gmsh:physical"),
    "gmsh 2.2 ascii": ("tip.msh", {"file_format": "gmsh22", "binary": False}, "gmsh:physical"),
    "vtu": ("tip.vtu", {}, "region"),
}


# As gmsh 4.15 saves one square in two physical surfaces, with one named edge.
GMSH41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 3 "left"
2 1 "soft"
2 2 "hard"
$EndPhysicalNames
$Entities
0 1 2 0
4 0 0 0 0 1 0 1 3 0
1 0 0 0 1 1 0 1 2 0
2 0 0 0 1 1 0 1 1 0
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
3 3 1 3
1 4 1 1
1 4 1
2 1 2 1
2 1 2 3
2 2 2 1
3 1 3 4
$EndElements
"""


def test_reads_a_gmsh_41_file(tmp_path):
    """Physical groups hang on entities there; several blocks make up the cells."""
    path = tmp_path / "square.msh"
    if COMM.rank == 0:
        path.write_text(GMSH41)
    COMM.barrier()
    body = read(COMM, path)
    points, cells, tags = in_file_order(body)
    np.testing.assert_array_equal(points, [[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(cells, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(tags, [2, 1])
    assert vertices(body, {"tag": "left"}) == vertices(body, {"tag": 3}) == [0, 3]
    assert vertices(body, {"tag": "soft"}) == [0, 2, 3]


@pytest.mark.parametrize("name", FORMATS)
def test_reads_points_cells_and_tags(name, tmp_path):
    """Points, cells and cell tags come back in the order of the file."""
    file, options, key = FORMATS[name]
    data = {key: [np.array([7, 4])]}
    if key == "gmsh:physical":
        data["gmsh:geometrical"] = [np.array([1, 1])]
    path = write(tmp_path / file, TIP, [("tetra", TETRAHEDRA)], cell_data=data, **options)
    points, cells, tags = in_file_order(read(COMM, path))
    np.testing.assert_array_equal(points, TIP)
    np.testing.assert_array_equal(cells, np.sort(TETRAHEDRA))
    np.testing.assert_array_equal(tags, [7, 4])


def test_reads_a_flat_mesh_of_triangles(tmp_path):
    """Gmsh gives planar meshes a third coordinate; the body is 2D."""
    points = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]
    path = write(tmp_path / "flat.msh", points, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))])
    body = read(COMM, path)
    assert body.mesh.geometry.dim == 2
    np.testing.assert_array_equal(in_file_order(body)[0], np.array(points)[:, :2])
    assert vertices(body, {"x": "max"}) == [1, 2]


# meshio's name, and the place of each vertex among DOLFINx's.
VTK = {
    "quadrilateral": ("quad", [0, 1, 3, 2]),
    "hexahedron": ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6]),
}


def skewed(cell: str) -> tuple[np.ndarray, np.ndarray]:
    """Points, and cells with vertices in VTK's order, of a distorted box."""
    d = 2 if cell in CELLS[2] else 3
    points, _, _ = in_file_order(box(COMM, (3.0, 2.0, 2.0)[:d], (3, 2, 2)[:d], cell))
    body = box(MPI.COMM_SELF, (3.0, 2.0, 2.0)[:d], (3, 2, 2)[:d], cell)
    cells = body.file_connectivity()[np.argsort(body.file_cells)]
    return points + 0.1 * np.sin(points[:, ::-1] * 2.0 + points), cells[:, VTK[cell][1]]


@pytest.mark.parametrize("cell", VTK)
@pytest.mark.parametrize("name", FORMATS)
def test_reads_quadrilaterals_and_hexahedra(name, cell, tmp_path):
    """In the order of the file; what they fill by Gauss's rule on the file's own vertices."""
    file, options, key = FORMATS[name]
    points, cells = skewed(cell)
    d = points.shape[1]
    tags = 1 + np.arange(len(cells)) % 3
    data = {key: [tags]}
    if key == "gmsh:physical":
        data["gmsh:geometrical"] = [np.ones_like(tags)]
    padded = np.hstack([points, np.zeros((len(points), 3 - d))])
    path = write(tmp_path / file, padded, [(VTK[cell][0], cells)], cell_data=data, **options)
    body = read(COMM, path)
    found, sets, found_tags = in_file_order(body)
    np.testing.assert_allclose(found, points, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(sets, np.sort(cells))
    np.testing.assert_array_equal(found_tags, tags)

    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    if d == 3:
        corner = np.vstack([np.c_[corner, np.full(4, -1)], np.c_[corner, np.ones(4)]])
    volumes = np.zeros(len(cells))
    for gauss in product((-(3**-0.5), 3**-0.5), repeat=d):
        factors = (1 + corner * gauss) / 2
        slopes = [corner[:, i] / 2 * np.delete(factors, i, axis=1).prod(axis=1) for i in range(d)]
        volumes += np.abs(np.linalg.det(np.einsum("kai,ja->kij", points[cells], slopes)))
    volume = fem.form(ufl.TestFunction(fem.functionspace(body.mesh, ("DG", 0))) * ufl.dx)
    mine = fem.assemble_vector(volume).array[: len(body.file_cells)]
    np.testing.assert_allclose(mine, volumes[body.file_cells], rtol=1e-13)


def test_groups_of_hexahedra(tmp_path):
    """A tagged quadrilateral is a facet there."""
    points, cells = skewed("hexahedron")
    top = np.array([[24, 25, 29, 28]])
    path = write(
        tmp_path / "bricks.msh",
        points,
        [("hexahedron", cells), ("quad", top)],
        cell_data={"gmsh:physical": [np.ones(len(cells), dtype=int), np.array([4])]},
        file_format="gmsh22",
    )
    assert vertices(read(COMM, path), {"tag": 4}) == sorted(top[0].tolist())


def test_groups_of_a_gmsh_file(tmp_path):
    """Physical groups are vertex sets by name, and by number below the cells' dimension."""
    path = write(
        tmp_path / "named.msh",
        TIP,
        [("tetra", TETRAHEDRA), ("triangle", BASE), ("vertex", np.array([[0]]))],
        cell_data={
            "gmsh:physical": [np.array([1, 2]), np.array([1, 1]), np.array([5])],
            "gmsh:geometrical": [np.array([1, 1]), np.array([1, 1]), np.array([1])],
        },
        field_data={"base": np.array([1, 2]), "steel": np.array([2, 3]), "apex": np.array([5, 0])},
        file_format="gmsh22",
    )
    body = read(COMM, path)
    assert vertices(body, {"tag": "base"}) == vertices(body, {"tag": 1}) == [1, 2, 3, 4]
    assert vertices(body, {"tag": "apex"}) == vertices(body, {"tag": 5}) == [0]
    assert vertices(body, {"tag": "steel"}) == [0, 1, 2, 3]
    with pytest.raises(MeshError, match=r'tag = "lid" }: the mesh has no such tag; tags: .*base'):
        body.dofs(p1(body), Where.parse({"tag": "lid"}))
    # Number 2 tags cells only: a mistake for a boundary, not a way to clamp half the body.
    with pytest.raises(MeshError, match="no such tag"):
        body.dofs(p1(body), Where.parse({"tag": 2}))


def test_groups_of_a_medit_file(tmp_path):
    """References of triangles, and where no triangle has one, of vertices."""
    path = write(
        tmp_path / "refs.mesh",
        TIP,
        [("tetra", TETRAHEDRA), ("triangle", BASE)],
        point_data={"medit:ref": np.array([3, 8, 0, 3, 0])},
        cell_data={"medit:ref": [np.array([1, 1]), np.array([0, 8])]},
    )
    body = read(COMM, path)
    assert vertices(body, {"tag": 8}) == [1, 2, 4]
    assert vertices(body, {"tag": 3}) == [0, 3]


@pytest.mark.parametrize("cell", CELLS[3])
def test_reads_what_dolfinx_writes(cell, tmp_path):
    """XDMF with HDF5 data: cell and facet tags of a mesh written by DOLFINx."""
    body = box(COMM, (2.0, 1.0, 1.0), (4, 1, 2), cell)
    msh = body.mesh
    cells = np.arange(len(body.file_cells), dtype=np.int32)
    right = compute_midpoints(msh, 3, cells)[:, 0] > 1
    halves = meshtags(msh, 3, cells, np.where(right, 2, 1).astype(np.int32))
    facets = np.sort(locate_entities_boundary(msh, 2, lambda x: np.isclose(x[0], 2.0)))
    end = meshtags(msh, 2, facets, np.full(len(facets), 9, dtype=np.int32))
    halves.name, end.name = "halves", "end"
    path = tmp_path / "tags.xdmf"
    msh.topology.create_connectivity(2, 3)
    with XDMFFile(COMM, path, "w") as file:
        file.write_mesh(msh)
        file.write_meshtags(halves, msh.geometry)
        file.write_meshtags(end, msh.geometry)
    COMM.barrier()

    back = read(COMM, path)
    assert back.num_cells == body.num_cells
    points, cells, tags = in_file_order(back)
    np.testing.assert_array_equal(tags, 1 + (points[cells].mean(axis=1)[:, 0] > 1))
    assert vertices(back, {"tag": 9}) == np.flatnonzero(points[:, 0] == 2.0).tolist()


BAR = ((2.0, 1.0, 1.0), (4, 2, 2))


@pytest.mark.parametrize(
    ("clause", "inside"),
    [
        ({"x": "min"}, lambda x: x[0] == 0),
        ({"y": "max"}, lambda x: x[1] == 1),
        ({"x": [0.5, 1.0]}, lambda x: (x[0] >= 0.5) & (x[0] <= 1)),
        ({"x": [-9, 0.7], "z": "max"}, lambda x: (x[0] <= 0.7) & (x[2] == 1)),
        ({"vertices": [0, 5, 44]}, lambda x: np.isin(np.arange(45), [0, 5, 44])),
        ({"vertices": [0, 4, 44], "x": "max"}, lambda x: np.isin(np.arange(45), [4, 44])),
    ],
)
def test_vertex_sets(clause, inside):
    """A set holds the vertices that meet every condition."""
    points, _, _ = in_file_order(body := box(COMM, *BAR))
    found = vertices(body, clause)
    assert found == np.flatnonzero(inside(points.T)).tolist()


def test_planes_allow_for_single_precision(tmp_path):
    """Rounded coordinates still lie on the plane they were meant for."""
    points = TIP.copy()
    points[[1, 3], 0] = [1.0, np.float32(1) - np.float32(6e-8)]
    path = write(tmp_path / "rounded.vtu", points, [("tetra", TETRAHEDRA)])
    assert vertices(read(COMM, path), {"x": "max"}) == [1, 3]


@pytest.mark.parametrize(
    ("clause", "message"),
    [
        ({"x": [3, 4]}, r"x = \[3, 4\] } holds no vertex; the mesh spans x from 0 to 2, y from 0"),
        ({"vertices": [45]}, "vertex 45 is out of range; the mesh has vertices 0 to 44"),
        ({"tag": "left"}, "no such tag; tags: none"),
    ],
    ids=str,
)
def test_sets_a_mesh_does_not_have(clause, message):
    """The message says what the mesh has instead."""
    body = box(COMM, *BAR)
    with pytest.raises(MeshError, match=message):
        body.dofs(p1(body), Where.parse(clause))


def test_an_axis_the_mesh_does_not_have():
    """A 2D mesh has no z."""
    body = box(COMM, (1.0, 1.0), (1, 1))
    with pytest.raises(MeshError, match="the mesh is 2D and has no z axis"):
        body.dofs(p1(body), Where.parse({"z": "max"}))


@pytest.mark.parametrize(
    ("clause", "message"),
    [
        ("x", "must be a table"),
        ({}, "must be a table"),
        ({"x": "left"}, 'x must be "min", "max" or an interval'),
        ({"x": 1.0}, 'x must be "min", "max" or an interval'),
        ({"x": [1, 0]}, "x = .1, 0. is empty"),
        ({"x": [0, True]}, 'x must be "min", "max" or an interval'),
        ({"vertices": [-1]}, "vertex numbers, counted from 0"),
        ({"vertices": []}, "vertex numbers, counted from 0"),
        ({"tag": 1.5}, "a name or a whole number"),
        ({"vertexes": [1]}, r"unknown key vertexes \(did you mean vertices\?\)"),
    ],
    ids=str,
)
def test_clauses_that_say_nothing(clause, message):
    """A malformed clause is refused with what would be right."""
    with pytest.raises(ValueError, match=message):
        Where.parse(clause)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_dofs_on_a_side_are_those_of_its_facets(cell, degree):
    """Whatever the degree, also of those whose cells no rank but another owns."""
    d = 2 if cell in CELLS[2] else 3
    body = box(COMM, (2.0, 1.0, 1.0)[:d], (3, 2, 1)[:d], cell)
    V = fem.functionspace(body.mesh, ("Lagrange", degree, (d,)))
    found = body.dofs(V, Where.parse({"x": "max"}))
    expected = fem.locate_dofs_geometrical(V, lambda X: X[0] > 2.0 - 1e-9)
    np.testing.assert_array_equal(found, np.sort(expected))
    owned = int((found < V.dofmap.index_map.size_local).sum())
    assert COMM.allreduce(owned) == (2 * degree + 1) * (degree + 1 if d == 3 else 1)


def test_only_linear_spaces_have_vertex_blocks():
    """Asking for the vertices of another space is an error, not a wrong answer."""
    body = box(COMM, (1.0, 1.0), (2, 2))
    for element in (("Lagrange", 2), ("DG", 0)):
        with pytest.raises(ValueError, match="continuous piecewise linear"):
            body.file_vertices(fem.functionspace(body.mesh, element))


REFUSED = {
    "lonely": (np.vstack([TIP, [[3, 3, 3]]]), [("tetra", TETRAHEDRA)], "1 vertex belongs to no"),
    "flat": (TIP * [1, 1, 0], [("tetra", TETRAHEDRA)], "2 cells have no volume .the first is cell"),
    "folded": (
        np.vstack([TIP[:4], [[0.9, 0.4, 0.0]]]),
        [("tetra", TETRAHEDRA)],
        "cells 0 and 1 .from 0. lie on the same side",
    ),
    "three on a facet": (
        np.vstack([TIP, [[0.5, 0.5, 3.0]]]),
        [("tetra", np.vstack([TETRAHEDRA, [[0, 1, 2, 5]]]))],
        "cells 0, 1 and 2 .from 0. share one facet",
    ),
    "not finite": (
        np.where(TIP == 0.3, np.nan, TIP),
        [("tetra", TETRAHEDRA)],
        "vertex 0 .from 0. has coordinates",
    ),
    "mixed": (
        np.vstack([TIP[1:5], TIP[1:5] - [0, 0, 1], TIP[:1]])[:, [0, 1, 2]],
        [("hexahedron", np.array([[1, 2, 0, 3, 5, 6, 4, 7]])), ("tetra", np.array([[8, 1, 0, 3]]))],
        "a mix of cells of type hexahedron",
    ),
    "curved": (
        np.arange(30.0).reshape(10, 3),
        [("tetra10", np.arange(10).reshape(1, 10))],
        "cells of type tetra10; straight triangles or quadrilaterals .2D., tetrahedra or hexah",
    ),
    "mixed faces": (
        np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2, 0.5]]),
        [("quad", np.array([[0, 1, 2, 3]])), ("triangle", np.array([[1, 4, 2]]))],
        "a mix of cells of type quad, triangle; straight",
    ),
    "crossed": (
        np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
        [("quad", np.array([[0, 1, 3, 2]]))],
        "1 cell is not convex, or lists its vertices in another order than the format's .the",
    ),
    "pointed": (
        np.array([[0, 0], [1, 0], [2, 0], [0, 1.0]]),
        [("quad", np.array([[0, 1, 2, 3]]))],
        "1 cell has no volume at a vertex .the first is cell 0",
    ),
    "folded quadrilaterals": (
        np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.1, 0.2], [0.1, 0.8]]),
        [("quad", np.array([[0, 1, 2, 3], [1, 4, 5, 2]]))],
        "cells 0 and 1 .from 0. lie on the same side",
    ),
    "no cells": (TIP[:2], [("line", np.array([[0, 1]]))], "has no cells"),
    "surface": (TIP[:3], [("triangle", np.array([[0, 1, 2]]))], "is a surface in space; fill it"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_meshes_that_are_refused(case, tmp_path):
    """One clear line, on every rank."""
    points, cells, message = REFUSED[case]
    path = write(tmp_path / f"{case}.vtu", points, cells)
    with pytest.raises(MeshError, match=message) as error:
        read(COMM, path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("absent.mesh", None, "no such file"),
        ("noise.mesh", "Lorem ipsum\ndolor", "cannot be read as a mesh"),
        ("cut.mesh", "MeshVersionFormatted 2\nDimension 3\nVertices\n4\n0 0 0", "cannot be read"),
        ("noise.msh", "\x00\x01\x02", "cannot be read as a mesh"),
        ("what.blend", "x", "Could not deduce file format"),
        ("noise.xdmf", "<Xdmf", "cannot be read as XDMF"),
        ("empty.xdmf", "<Xdmf><Domain/></Xdmf>", "no <Grid> with a <Topology>"),
        (
            "inline.xdmf",
            "<Xdmf><Domain><Grid Name='g'><Topology TopologyType='Triangle'><DataItem Format='XML'"
            " Dimensions='1 3'>0 1 2</DataItem></Topology></Grid></Domain></Xdmf>",
            "keeps its numbers in the XML",
        ),
        (
            "range.mesh",
            "MeshVersionFormatted 2\nDimension 2\nVertices\n3\n0 0 0\n1 0 0\n0 1 0\n"
            "Triangles\n1\n1 2 9 0\nEnd",
            "a cell names a vertex that the file's 3 do not include",
        ),
    ],
)
def test_files_that_cannot_be_read(name, text, message, tmp_path, capfd):
    """The reader's own chatter is silenced; its reason is in the one line."""
    path = tmp_path / name
    if text is not None and COMM.rank == 0:
        path.write_text(text)
    COMM.barrier()
    with pytest.raises(MeshError, match=message) as error:
        read(COMM, path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("size", "cells", "message"),
    [
        ((1.0,), (1,), "2 or both 3 entries, not 1 and 1"),
        ((1.0, 1.0, 1.0), (1, 1), "2 or both 3 entries, not 3 and 2"),
        ((1.0, 0.0), (1, 1), "size must be positive lengths"),
        ((1.0, 1.0), (1, 0), "cells must be 1 or more"),
    ],
)
def test_boxes_that_are_refused(size, cells, message):
    """Sizes and counts are checked before DOLFINx sees them."""
    with pytest.raises(MeshError, match=message):
        box(COMM, size, cells)


def test_kinds_of_cells_that_are_refused():
    with pytest.raises(MeshError, match="must be triangle or quadrilateral in 2D, not 'hexahedro"):
        box(COMM, (1.0, 1.0), (1, 1), "hexahedron")


def test_facet_vertices_are_those_of_the_geometry():
    """Connectivity in file numbers agrees with DOLFINx's own map from cells to geometry."""
    body = box(COMM, (1.0, 1.0, 1.0), (2, 1, 1))
    cells = np.arange(len(body.file_cells), dtype=np.int32)
    nodes = entities_to_geometry(body.mesh, 3, cells)
    np.testing.assert_array_equal(
        np.sort(body.file_connectivity()),
        np.sort(body.mesh.geometry.input_global_indices[nodes]),
    )
