"""What files of each format give: points, cells, tags and groups, in the order of the file."""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import meshio
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.io import XDMFFile
from dolfinx.mesh import compute_midpoints, locate_entities_boundary, meshtags

from meshes import CELLS, MeshError, Where, box, read
from tests.mesh_files import (
    BASE,
    COMM,
    TAGS,
    TETRAHEDRA,
    TIP,
    check_tip,
    in_file_order,
    p1,
    put_text,
    vertices,
    write,
)

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
    body = read(COMM, put_text(tmp_path / "square.msh", GMSH41))
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


# Tags, whatever their shape


@pytest.mark.parametrize("shape", ["(n,)", "(n, 1)", "real", "unsigned", "bytes"])
def test_tags_however_the_file_has_them(shape, tmp_path):
    tags = {
        "(n,)": np.array(TAGS),
        "(n, 1)": np.array(TAGS)[:, None],
        "real": np.array(TAGS, dtype=np.float64),
        "unsigned": np.array(TAGS, dtype=np.uint64),
        "bytes": np.array(TAGS, dtype=np.int8),
    }[shape]
    # Real data that are not whole, or no tags by their size, are something else.
    data = {"stress": [np.array([0.5, 1.0])], "modulus": [np.array([1e11, 2e9])], "MatID": [tags]}
    path = write(tmp_path / "tip.vtu", TIP, [("tetra", TETRAHEDRA)], cell_data=data)
    check_tip(read(COMM, path))


def test_a_telling_name_goes_first(tmp_path):
    data = {"GlobalCellIds": [np.array([0, 1])], "Material": [np.array(TAGS, dtype=float)]}
    path = write(tmp_path / "tip.vtu", TIP, [("tetra", TETRAHEDRA)], cell_data=data)
    check_tip(read(COMM, path))


@pytest.mark.parametrize("tag", [2**31 - 1, -(2**31)])
def test_tags_of_32_bits(tag, tmp_path):
    data = {"region": [np.array([tag, 1])]}
    path = write(tmp_path / "tip.vtu", TIP, [("tetra", TETRAHEDRA)], cell_data=data)
    check_tip(read(COMM, path), [tag, 1])


def test_tags_beyond_32_bits_are_refused(tmp_path):
    """DOLFINx would cut them off without a word."""
    tag = 2**32 + 7
    data = {"region": [np.array([tag, 1])]}
    path = write(tmp_path / "tip.vtu", TIP, [("tetra", TETRAHEDRA)], cell_data=data)
    with pytest.raises(MeshError, match="tags a tetra with 4294967303; a tag must lie between"):
        read(COMM, path)
    text = GMSH41.replace("1 1 0 1 2 0", f"1 1 0 1 {tag} 0")
    with pytest.raises(MeshError, match="tags a triangle with 4294967303; a tag must lie"):
        read(COMM, put_text(tmp_path / "square.msh", text))


# Flat meshes


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("noise", [0.0, 1e-17, 1e-12, 1e-7])
def test_flat_meshes(axis, noise, tmp_path):
    """In any coordinate plane, and not quite: the two other coordinates in their order."""
    plane = np.array([[0, 0], [2, 0], [2, 1], [0, 1.0]])
    points = np.insert(plane, axis, 5.0 + noise * np.array([1, -1, 0.3, -0.2]), axis=1)
    path = write(tmp_path / "flat.vtu", points, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))])
    np.testing.assert_array_equal(in_file_order(read(COMM, path))[0], plane)


def test_a_surface_is_not_flat(tmp_path):
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 1e-4], [0, 1.0, 0]])
    path = write(tmp_path / "bent.vtu", points, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))])
    with pytest.raises(MeshError, match="is a surface in space; fill it"):
        read(COMM, path)


def test_scale(tmp_path):
    """Millimetres, for planes and extents too."""
    path = write(tmp_path / "tip.vtu", 1000 * TIP, [("tetra", TETRAHEDRA)])
    body = read(COMM, path, scale=0.001)
    np.testing.assert_allclose(in_file_order(body)[0], TIP, rtol=1e-15)
    assert vertices(body, {"x": [0.9, 1.1]}) == [1, 3]
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(MeshError, match=r"tip.vtu: scale must be above 0, not"):
            read(COMM, path, scale=scale)


def test_cells_that_meshio_leaves_out_are_told(tmp_path):
    """It reads a file of voxels and hexahedra, and drops the voxels."""
    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], dtype=float)
    cells = np.array([[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]])
    path = tmp_path / "voxels.vtu"
    if COMM.rank == 0:
        mesh = meshio.Mesh(points, [("hexahedron", cells)])
        meshio.vtu.write(path, mesh, binary=False)
        path.write_text(path.read_text().replace("\n12\n12\n", "\n12\n11\n"))
    COMM.barrier()
    with pytest.raises(MeshError, match="has cells of VTK's type 11, which are not read from here"):
        read(COMM, path)
