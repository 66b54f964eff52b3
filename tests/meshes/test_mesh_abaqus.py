"""Input files of Abaqus and CalculiX, in the forms that programs write."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem

from meshes import MeshError, Where, read
from tests.mesh_files import (
    COMM,
    TETRAHEDRA,
    TIP,
    cells_of,
    check_tip,
    in_file_order,
    put_text,
    rows,
    vertices,
)

NODES = rows(TIP, 1, ", ")
CELLS = rows(TETRAHEDRA + 1, 1, ", ")
FLAT = f"""** written by hand
*HEADING
two tetrahedra
*Node, nset=Nall
{NODES}*ELEMENT, TYPE=C3D4, ELSET=EALL
{CELLS}*NSET, NSET=TIPS, GENERATE
1, 5, 4
*NSET, NSET=ROUND
TIPS, 2
*ELSET, ELSET=SOFT
1,
*Elset, elset=HARD
2,
*ELSET, ELSET=BOTH
SOFT, HARD
*NSET, NSET=OF_HARD, ELSET=HARD
*SURFACE, NAME=FACE, TYPE=ELEMENT
SOFT, S1
*SURFACE, NAME=FREE
EALL,
*SURFACE, NAME=POINTS, TYPE=NODE
TIPS, 1.
*MATERIAL, NAME=RUBBER
*ELASTIC
1.0, 0.45
*STEP
*NODE FILE
U
*END STEP
"""


def area(body, name: str) -> float:
    """Area of a part of the boundary."""
    form = fem.form(fem.Constant(body.mesh, 1.0) * body.ds(Where(tag=name)))
    return float(COMM.allreduce(fem.assemble_scalar(form)))


def triangle(*corners: int) -> float:
    """Area of a triangle of TIP."""
    a, b, c = TIP[list(corners)]
    return float(np.linalg.norm(np.cross(b - a, c - a)) / 2)


def test_a_flat_file(tmp_path):
    """Sets by number, name and range; regions by element set; surfaces by face."""
    body = read(COMM, put_text(tmp_path / "flat.inp", FLAT))
    check_tip(body, [0, 0])
    assert vertices(body, {"tag": "Nall"}) == [0, 1, 2, 3, 4]
    assert vertices(body, {"tag": "TIPS"}) == vertices(body, {"tag": "POINTS"}) == [0, 4]
    assert vertices(body, {"tag": "ROUND"}) == [0, 1, 4]
    assert vertices(body, {"tag": "OF_HARD"}) == [0, 1, 2, 3]
    assert [cells_of(body, t) for t in ("SOFT", "HARD", "BOTH", "EALL")] == [
        [0],
        [1],
        [0, 1],
        [0, 1],
    ]
    regions = body.regions(["SOFT", "HARD"])
    found = body.gather(regions.values[: len(body.file_cells)], everywhere=True)
    np.testing.assert_array_equal(found, [0, 1])
    # S1 of the first element: its nodes 1, 2, 3, which are the vertices 0, 2, 1
    assert vertices(body, {"tag": "FACE"}) == [0, 1, 2]
    with pytest.raises(MeshError, match="holds no facet of the boundary"):
        body.ds(Where(tag="FACE"))  # which lies between the two
    faces = [(0, 2, 4), (0, 1, 4), (1, 2, 4), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    assert area(body, "FREE") == pytest.approx(sum(triangle(*f) for f in faces), rel=1e-13)


SPELLINGS = {
    "two blocks of nodes": FLAT.replace(
        "3, 0.0, 0.0, 0.0\n", "*NODE, NSET=ZERO\n3, 0.0, 0.0, 0.0\n"
    ),
    "continued lines": FLAT.replace("TYPE=C3D4, ELSET", "TYPE=C3D4,\n ELSET").replace(
        "1, 1, 3, 2, 5\n", "1, 1, 3,\n  2, 5\n"
    ),
    "small letters": FLAT.replace(
        "*ELEMENT, TYPE=C3D4, ELSET=EALL", "*element,type=c3d4,elset=EALL"
    ),
    "carriage returns": FLAT.replace("\n", "\r\n"),
    "other numbers": FLAT.replace(NODES, rows(TIP, 7, ", ")).replace(
        CELLS, rows(TETRAHEDRA + 7, 1, ", ")
    ),
    "reduced elements": FLAT.replace("C3D4", "C3D4H"),
    "blanks for zeros": FLAT.replace("3, 0.0, 0.0, 0.0\n", "3\n").replace(
        "4, 1.0, 0.0, 0.0", "4, 1.0, , 0."
    ),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings(spelling, tmp_path):
    text = SPELLINGS[spelling]
    if spelling == "other numbers":
        text = text.replace("1, 5, 4\n", "7, 11, 4\n").replace("TIPS, 2\n", "TIPS, 8\n")
    assert text != FLAT
    body = read(COMM, put_text(tmp_path / "flat.inp", text))
    check_tip(body, [0, 0])
    assert vertices(body, {"tag": "ROUND"}) == [0, 1, 4]


def test_included_files(tmp_path):
    """Beside the file, whatever the folder that the program runs in."""
    put_text(tmp_path / "nodes.txt", NODES)
    put_text(tmp_path / "cells.inp", f"*ELEMENT, TYPE=C3D4\n{CELLS}")
    text = "*NODE, INPUT=nodes.txt\n*INCLUDE, INPUT=cells.inp\n"
    check_tip(read(COMM, put_text(tmp_path / "whole.inp", text)), [0, 0])


PARTS = f"""*HEADING
*PART, NAME=A
*NODE
{NODES}*ELEMENT, TYPE=C3D4
{CELLS}*NSET, NSET=CLAMP
2, 3
*ELSET, ELSET=FIRST
1
*END PART
*PART, NAME=B
*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 0., 1., 0.
4, 0., 0., 1.
*ELEMENT, TYPE=C3D4, ELSET=FIRST
1, 1, 2, 3, 4
*NSET, NSET=CLAMP
1
*END PART
"""
ASSEMBLY = """*ASSEMBLY, NAME=WHOLE
*INSTANCE, NAME=A-1, PART=A
*END INSTANCE
*INSTANCE, NAME=B-1, PART=B
10., 0., 0.
*END INSTANCE
*INSTANCE, NAME=B-2, PART=B
20., 0., 0.
20., 0., 0., 20., 0., 1., 90.
*END INSTANCE
*NSET, NSET=PICKED, INSTANCE=B-2
2, 3
*NSET, NSET=PICKED, INSTANCE=A-1
1
*NSET, NSET=OTHERS
B-1.CLAMP, A-1.4
*ELSET, ELSET=_TOP_S2, INTERNAL, INSTANCE=B-2
1,
*SURFACE, TYPE=ELEMENT, NAME=TOP
_TOP_S2, S2
*END ASSEMBLY
"""


def test_parts_are_kept_apart(tmp_path):
    """Each numbers its nodes by itself; sets of one name in several parts are one set."""
    body = read(COMM, put_text(tmp_path / "parts.inp", PARTS))
    points, cells, _ = in_file_order(body)
    np.testing.assert_array_equal(points[:5], TIP)
    np.testing.assert_array_equal(points[5:], np.vstack([np.zeros(3), np.eye(3)]))
    np.testing.assert_array_equal(cells[2], [5, 6, 7, 8])
    assert vertices(body, {"tag": "CLAMP"}) == [1, 2, 5]
    assert vertices(body, {"tag": "B.CLAMP"}) == [5]
    assert [cells_of(body, t) for t in ("FIRST", "A.FIRST", "A", "B")] == [[0, 2], [0], [0, 1], [2]]


def test_instances_are_put_in_their_places(tmp_path):
    """Moved, and turned by 90° about z; sets and surfaces of the assembly refer to them."""
    body = read(COMM, put_text(tmp_path / "assembly.inp", PARTS + ASSEMBLY))
    points, _, _ = in_file_order(body)
    tetrahedron = np.vstack([np.zeros(3), np.eye(3)])
    np.testing.assert_allclose(points[5:9], tetrahedron + np.array([10, 0, 0]), atol=1e-14)
    turned = tetrahedron @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [20, 0, 0]
    np.testing.assert_allclose(points[9:], turned, atol=1e-13)
    assert vertices(body, {"tag": "PICKED"}) == [0, 10, 11]
    assert vertices(body, {"tag": "OTHERS"}) == [3, 5]
    assert vertices(body, {"tag": "CLAMP"}) == [1, 2, 5, 9]
    assert vertices(body, {"tag": "B-2.CLAMP"}) == [9]
    assert cells_of(body, "B-2") == [3]
    assert "_TOP_S2" not in body.groups
    # S2 is nodes 1, 4, 2
    assert vertices(body, {"tag": "TOP"}) == [9, 10, 12]
    assert area(body, "TOP") == pytest.approx(0.5, rel=1e-12)


def test_skins_are_facets(tmp_path):
    """Shells on the faces of solids, which FreeCAD and gmsh write, tag them."""
    text = FLAT.replace(
        "*NSET, NSET=TIPS", "*ELEMENT, TYPE=S3, ELSET=SKIN\n11, 2, 3, 4\n*NSET, NSET=TIPS"
    )
    body = read(COMM, put_text(tmp_path / "skin.inp", text))
    check_tip(body, [0, 0])
    assert area(body, "SKIN") == pytest.approx(triangle(1, 2, 3), rel=1e-13)


BRICK = """*NODE
1, 0, 0, 0
2, 2, 0, 0
3, 2, 3, 0
4, 0, 3, 0
5, 0, 0, 4
6, 2, 0, 4
7, 2, 3, 4
8, 0, 3, 4
*ELEMENT, TYPE=C3D8R, ELSET=E
1, 1, 2, 3, 4, 5, 6, 7, 8
"""


@pytest.mark.parametrize(
    ("face", "nodes"),
    [
        *((1, [0, 1, 2, 3]), (2, [4, 5, 6, 7]), (3, [0, 1, 4, 5])),
        *((4, [1, 2, 5, 6]), (5, [2, 3, 6, 7]), (6, [0, 3, 4, 7])),
    ],
)
def test_faces_of_bricks(face, nodes, tmp_path):
    """In Abaqus's order: S1 and S2 below and above, S3 to S6 around."""
    text = f"{BRICK}*SURFACE, NAME=SIDE\nE, S{face}\n"
    body = read(COMM, put_text(tmp_path / "brick.inp", text))
    assert vertices(body, {"tag": "SIDE"}) == nodes
    assert area(body, "SIDE") == pytest.approx({1: 6, 2: 6, 3: 8, 5: 8, 4: 12, 6: 12}[face])


PLATE = "*NODE\n1, 0, 0\n2, 2, 0\n3, 2, 1\n4, 0, 1\n*ELEMENT, TYPE=CPE4, ELSET=E\n1, 1, 2, 3, 4\n"


@pytest.mark.parametrize(("face", "nodes"), [(1, [0, 1]), (2, [1, 2]), (3, [2, 3]), (4, [0, 3])])
def test_a_plane_file(face, nodes, tmp_path):
    text = f"{PLATE}*SURFACE, NAME=SIDE\n1, S{face}\n"
    body = read(COMM, put_text(tmp_path / "plate.inp", text))
    assert body.mesh.geometry.dim == 2
    assert vertices(body, {"tag": "SIDE"}) == nodes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("TYPE=C3D4", "TYPE=C3D10", "has cells of type tetra10; straight"),
        ("TYPE=C3D4", "TYPE=CAX4", "has elements of type CAX4; C3D4, C3D8, CPS3"),
        ("TYPE=C3D4, ", "", "has .ELEMENT without TYPE="),
        ("1, 1, 3, 2, 5\n", "1, 1, 3, 2\n", "has 9 numbers under .ELEMENT, TYPE=C3D4, where rows"),
        ("1, 1, 3, 2, 5\n", "1, 1, 3, 2, 99\n", "an element names node 99, which it does not"),
        ("1, 1, 3, 2, 5\n", "1, 1, 3, 2, x\n", "something else than numbers under .ELEMENT"),
        ("TIPS, 2\n", "TOPS, 2\n", "has a set ROUND of a set TOPS, which it does not define"),
        ("*ELSET, ELSET=SOFT\n1,", "*ELSET, ELSET=SOFT\n8,", "the set SOFT names element 8, which"),
        ("SOFT, S1", "SOFT, S5", "has a surface on side S5 of a tetra, which that does not have"),
        ("1, 5, 4\n", "1, 5, 0\n", "has .NSET, GENERATE with other than first, last, step"),
        ("*Node, nset=Nall", "*Node, SYSTEM=C", "has nodes in cylindrical or spherical coord"),
        ("*HEADING", "*INCLUDE, INPUT=none.inp", "includes none.inp, which is not there"),
        ("*HEADING", "*INCLUDE, INPUT=flat.inp", "includes files more than 10 deep"),
    ],
)
def test_files_that_are_refused(old, new, message, tmp_path):
    assert old in FLAT
    path = put_text(tmp_path / "flat.inp", FLAT.replace(old, new, 1))
    with pytest.raises(MeshError, match=message) as error:
        read(COMM, path)
    assert "\n" not in str(error.value)
