"""VTK's legacy files, in the versions and kinds that there are."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from meshes import MeshError, read
from tests.mesh_files import (
    COMM,
    TETRAHEDRA,
    TIP,
    check_tip,
    in_file_order,
    put_text,
    rows,
    vertices,
    write,
)

HEAD = "# vtk DataFile Version 3.0\na title\nASCII\nDATASET UNSTRUCTURED_GRID\n"
TETS = f"""{HEAD}POINTS 5 double
{rows(TIP)}CELLS 2 10
{rows(np.c_[[4, 4], TETRAHEDRA])}CELL_TYPES 2
10
10
"""
SCALARS = "CELL_DATA 2\nSCALARS material int 1\nLOOKUP_TABLE default\n4\n9\n"
FIELD = (
    "CELL_DATA 2\nFIELD FieldData 3\nstress 6 2 float\n1 2 3 4 5 6 7 8 9 10 11 12\nMETADATA\n"
    "INFORMATION 0\n\nRegionId 1 2 {}\n4 9\nnames 1 2 string\nsoft\nhard\n"
)
VERSION5 = f"""# vtk DataFile Version 5.1
vtk output
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 5 double
{rows(TIP)}METADATA
INFORMATION 1
NAME L2_NORM_RANGE LOCATION vtkDataArray
DATA 2 0 1

CELLS 3 8
OFFSETS vtktypeint64
0 4 8
CONNECTIVITY vtktypeint64
{rows(TETRAHEDRA)}CELL_TYPES 2
10
10

POINT_DATA 5
SCALARS height double
1 0 0 0 0
VECTORS pull float
{rows(TIP)}
"""
FILES = {
    "scalars": TETS + SCALARS,
    "no lookup table": TETS + SCALARS.replace("LOOKUP_TABLE default\n", ""),
    "real scalars": TETS + SCALARS.replace("int 1", "float"),
    "field": TETS + FIELD.format("int"),
    "real field": TETS + FIELD.format("double"),
    "5.1": VERSION5 + SCALARS,
    "5.1 field": VERSION5 + FIELD.format("vtktypeint64"),
    "colours first": TETS
    + "CELL_DATA 2\nCOLOR_SCALARS paint 3\n1 0 0 0 1 0\n"
    + SCALARS.replace("CELL_DATA 2\n", "").replace("default", "lut")
    + "LOOKUP_TABLE lut 2\n1 0 0 1 0 0 1 1\n",
    "one number a line": TETS.replace(rows(TIP), rows(TIP).replace(" ", "\n")) + SCALARS,
    "carriage returns": (TETS + SCALARS).replace("\n", "\r\n"),
}


@pytest.mark.parametrize("name", FILES)
def test_spellings(name, tmp_path):
    check_tip(read(COMM, put_text(tmp_path / "tip.vtk", FILES[name])))


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", ["vtk42", "vtk"])
def test_what_meshio_writes(version, binary, tmp_path):
    path = write(
        tmp_path / "tip.vtk",
        TIP,
        [("tetra", TETRAHEDRA)],
        cell_data={"stress": [np.ones((2, 3)) / 3], "region": [np.array([4, 9])]},
        file_format=version,
        binary=binary,
    )
    check_tip(read(COMM, path))


def test_lower_entities_are_tagged(tmp_path):
    """As gmsh exports: vertices, lines and triangles beside the cells, with entity numbers."""
    text = f"""{HEAD}POINTS 5 double
{rows(TIP)}
CELLS 6 23
1 0
2 1 2
3 1 2 3
3 1 2 4
{rows(np.c_[[4, 4], TETRAHEDRA])}
CELL_TYPES 6
1
3
5
5
10
10

CELL_DATA 6
SCALARS CellEntityIds int 1
LOOKUP_TABLE default
1
2
3
8
4
9
"""
    body = read(COMM, put_text(tmp_path / "tip.vtk", text))
    check_tip(body)
    assert vertices(body, {"tag": 1}) == [0]
    assert vertices(body, {"tag": 2}) == [1, 2]
    assert vertices(body, {"tag": 8}) == [1, 2, 4]


GRID = np.array([[x, y, z] for z, y, x in product((0.0, 1.0), (0.0, 1.0), (0.0, 1.0, 2.0))])


def test_voxels_are_hexahedra_and_pixels_quadrilaterals(tmp_path):
    """Beside hexahedra too; their vertices count along x, y and z."""
    voxel, brick = [0, 1, 3, 4, 6, 7, 9, 10], [1, 2, 5, 4, 7, 8, 11, 10]
    pixel = [1, 2, 4, 5]
    text = (
        f"{HEAD}POINTS 12 float\n{rows(GRID)}CELLS 3 23\n{rows([[8, *voxel], [8, *brick]])}"
        f"{rows([[4, *pixel]])}CELL_TYPES 3\n11 12 8\n{SCALARS.replace('2', '3', 1)}5\n"
    )
    points, cells, tags = in_file_order(body := read(COMM, put_text(tmp_path / "a.vtk", text)))
    np.testing.assert_array_equal(points, GRID)
    np.testing.assert_array_equal(cells, np.sort([voxel, brick]))
    np.testing.assert_array_equal(tags, [4, 9])
    assert vertices(body, {"tag": 5}) == pixel

    text = (
        f"{HEAD}POINTS 6 float\n{rows(GRID[:6])}CELLS 2 10\n4 0 1 3 4\n4 1 2 5 4\nCELL_TYPES 2\n"
        "8 9\n"
    )
    points, cells, _ = in_file_order(read(COMM, put_text(tmp_path / "b.vtk", text)))
    np.testing.assert_array_equal(points, GRID[:6, :2])
    np.testing.assert_array_equal(cells, [[0, 1, 3, 4], [1, 2, 4, 5]])


IMAGE = "# vtk DataFile Version 2.0\nimage\nASCII\n"
GRIDS = {
    "points": "DATASET STRUCTURED_POINTS\nDIMENSIONS 3 2 2\nORIGIN 0 0 0\nSPACING 1 1 1\n",
    "aspect": "DATASET STRUCTURED_POINTS\nDIMENSIONS 3 2 2\nASPECT_RATIO 1 1 1\nORIGIN 0 0 0\n",
    "rectilinear": "DATASET RECTILINEAR_GRID\nDIMENSIONS 3 2 2\nX_COORDINATES 3 float\n0 1 2\n"
    "Y_COORDINATES 2 float\n0 1\nZ_COORDINATES 2 float\n0 1\n",
    "grid": f"DATASET STRUCTURED_GRID\nDIMENSIONS 3 2 2\nPOINTS 12 float\n{rows(GRID)}",
}


@pytest.mark.parametrize("kind", GRIDS)
def test_grids(kind, tmp_path):
    """x runs fastest, of vertices and of cells."""
    path = put_text(tmp_path / "grid.vtk", IMAGE + GRIDS[kind] + SCALARS)
    points, cells, tags = in_file_order(read(COMM, path))
    np.testing.assert_array_equal(points, GRID)
    np.testing.assert_array_equal(cells, [[0, 1, 3, 4, 6, 7, 9, 10], [1, 2, 4, 5, 7, 8, 10, 11]])
    np.testing.assert_array_equal(tags, [4, 9])


def test_a_grid_of_one_layer_is_plane(tmp_path):
    text = IMAGE + GRIDS["points"].replace("3 2 2", "3 2 1")
    points, cells, _ = in_file_order(read(COMM, put_text(tmp_path / "grid.vtk", text)))
    np.testing.assert_array_equal(points, GRID[:6, :2])
    np.testing.assert_array_equal(cells, [[0, 1, 3, 4], [1, 2, 4, 5]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# vtk\n", "is no VTK file: it does not begin with # vtk DataFile Version"),
        (HEAD, "has no CELL_TYPES"),
        (HEAD.replace("UNSTRUCTURED_GRID", "POLYDATA"), "is POLYDATA; UNSTRUCTURED_GRID, STRUCT"),
        (TETS.replace("\n10\n10\n", "\n24\n24\n"), "has cells of type tetra10; straight"),
        (TETS.replace("\n10\n10\n", "\n13\n13\n"), "has cells of type wedge; straight"),
        (TETS.replace("\n10\n10\n", "\n10\n12\n"), "has a hexahedron with other than 8 vertices"),
        (TETS.replace("CELLS 2 10", "CELLS 2 12"), "has something else where 12 numbers are due"),
        (TETS.replace("POINTS 5", "POINTS 4"), "has a keyword '0.0' that is none of VTK's"),
        (TETS + SCALARS.replace("int 1", "complex 1"), "has data of type complex, which are not"),
        (IMAGE + GRIDS["points"].replace("3 2 2", "3 1 1"), "has no cells; straight"),
        (IMAGE + GRIDS["points"].replace("3 2 2", "3 2 0"), "DIMENSIONS other than three counts"),
    ],
)
def test_files_that_are_refused(text, message, tmp_path):
    with pytest.raises(MeshError, match=message) as error:
        read(COMM, put_text(tmp_path / "bad.vtk", text))
    assert "\n" not in str(error.value)
