"""Files as people's programs write them: in all spellings one and the same mesh."""

from __future__ import annotations

import numpy as np
import pytest

from meshes import MeshError, read
from tests.mesh_files import (
    BASE,
    COMM,
    TAGS,
    TETRAHEDRA,
    TIP,
    cells_of,
    check_tip,
    in_file_order,
    put_text,
    rows,
    vertices,
)

# The middle edge of the base.
EDGE = np.array([[1, 2]])


# gmsh


def gmsh_22(elements: list[tuple[int, list[int], list[int]]], names: str = "") -> str:
    """Version 2.2: kind, tags and vertices from 0 of each element."""
    listed = [
        f"{n} {kind} {len(tags)} {' '.join(map(str, [*tags, *(v + 1 for v in corners)]))}\n"
        for n, (kind, tags, corners) in enumerate(elements, 1)
    ]
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{names}$Nodes\n5\n{rows(TIP, 1)}$EndNodes\n"
        f"$Elements\n{len(listed)}\n{''.join(listed)}$EndElements\n"
    )


NAMES = '$PhysicalNames\n3\n2 3 "base"\n3 4 "all"\n2 8 "all"\n$EndPhysicalNames\n'


def test_gmsh_22_lists_an_element_once_a_group(tmp_path):
    """Cells and facets in two groups are one cell and one facet, in both."""
    first, second = (c.tolist() for c in TETRAHEDRA)
    elements = [
        *((2, [3, 1], BASE[0].tolist()), (2, [8, 1], BASE[0].tolist())),
        *((4, [4, 1], first), (4, [9, 2], second), (4, [4, 2], second), (4, [5, 1], first)),
    ]
    body = read(COMM, put_text(tmp_path / "tip.msh", gmsh_22(elements, NAMES)))
    check_tip(body)
    assert body.tagged_cells() == [4, 5, 9, "all"]
    assert vertices(body, {"tag": 3}) == vertices(body, {"tag": 8}) == [1, 2, 3]
    assert [cells_of(body, tag) for tag in (4, 5, 9, "all")] == [[0, 1], [0], [1], [0, 1]]
    # "all" is a surface and a volume: as a part of the boundary it is the surface.
    assert vertices(body, {"tag": "all"}) == [1, 2, 3]


def test_a_cell_twice_in_one_group_is_no_second_group(tmp_path):
    first, second = (c.tolist() for c in TETRAHEDRA)
    elements = [(4, [4, 1], first), (4, [9, 1], second), (4, [4, 1], first)]
    path = put_text(tmp_path / "tip.msh", gmsh_22(elements))
    with pytest.raises(
        MeshError, match=r"1 cell is listed twice: cell 2 .from 0. has the vertices of cell 0"
    ):
        read(COMM, path)


def test_gmsh_22_with_other_numbers_of_tags(tmp_path):
    """No tag, two, and four of a partitioned mesh; untagged cells beside tagged ones get 0."""
    first, second = (c.tolist() for c in TETRAHEDRA)
    elements = [(2, [3, 1, 1, 1], BASE[0].tolist()), (4, [], first), (4, [9, 2, 2, 1, -2], second)]
    body = read(COMM, put_text(tmp_path / "tip.msh", gmsh_22(elements)))
    check_tip(body, [0, 9])
    assert vertices(body, {"tag": 3}) == [1, 2, 3]


def gmsh_41(groups: dict[tuple[int, int], list[int]]) -> str:
    """Version 4.1: an entity for each cell and for the base, with their groups."""
    entities = []
    for dim, count in ((2, 1), (3, 2)):
        for k in range(1, count + 1):
            physical = groups.get((dim, k), [])
            words = " ".join(map(str, [len(physical), *physical]))
            entities.append(f"{k} 0 0 0 1 1 1 {words} 0\n")
    return (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
        f"{NAMES}$Entities\n0 0 1 2\n{''.join(entities)}$EndEntities\n"
        # sparse numbers, in two blocks, the second with parametric coordinates
        "$Nodes\n2 5 10 50\n3 1 0 2\n50\n20\n"
        f"{rows(TIP[:2])}2 1 1 3\n30\n40\n10\n{rows(np.c_[TIP[2:], np.zeros((3, 2))])}$EndNodes\n"
        "$Elements\n3 4 1 4\n2 1 2 2\n1 20 30 40\n2 20 30 10\n"
        "3 1 4 1\n3 50 30 20 10\n3 2 4 1\n4 40 50 20 30\n$EndElements\n"
    )


def test_gmsh_41_has_entities_in_two_groups(tmp_path):
    """Also one entity with a group turned round, which is written with a minus, and one without."""
    text = gmsh_41({(2, 1): [3, -8], (3, 1): [4, 5]})
    body = read(COMM, put_text(tmp_path / "tip.msh", text))
    check_tip(body, [4, 0])
    assert vertices(body, {"tag": 3}) == vertices(body, {"tag": "all"}) == [1, 2, 3, 4]
    assert body.tagged_cells() == [0, 4, 5, "all"]


def test_what_gmsh_itself_writes(tmp_path):
    """Its versions, text and binary, .mesh, .inp and .vtk, have the same mesh and groups."""
    gmsh = pytest.importorskip("gmsh", exc_type=(ImportError, OSError))
    files = {}
    if COMM.rank == 0:
        gmsh.initialize(interruptible=False)
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            for corner in (0, 1):
                gmsh.model.occ.addBox(corner, 0, 0, 1, 1, 1)
            gmsh.model.occ.fragment([(3, 1)], [(3, 2)])
            gmsh.model.occ.synchronize()
            left = gmsh.model.getEntitiesInBoundingBox(-1, -1, -1, 0.1, 2, 2, 2)
            gmsh.model.addPhysicalGroup(3, [1, 2], 1, "all")
            gmsh.model.addPhysicalGroup(3, [1], 2, "soft")
            gmsh.model.addPhysicalGroup(2, [s for _, s in left], 7, "clamp")
            gmsh.model.addPhysicalGroup(2, [s for _, s in gmsh.model.getEntities(2)], 8, "skin")
            gmsh.option.setNumber("Mesh.MeshSizeMax", 0.6)
            gmsh.model.mesh.generate(3)
            for name, version, binary in (
                *(("2t.msh", 2.2, 0), ("2b.msh", 2.2, 1), ("4t.msh", 4.1, 0), ("4b.msh", 4.1, 1)),
                *(("t.vtk", 4.1, 0), ("b.vtk", 4.1, 1), ("a.inp", 4.1, 0), ("a.mesh", 4.1, 0)),
            ):
                gmsh.option.setNumber("Mesh.MshFileVersion", version)
                gmsh.option.setNumber("Mesh.Binary", binary)
                gmsh.write(str(tmp_path / name))
                files[name] = name[-3:]
        finally:
            gmsh.finalize()
    files = COMM.bcast(files)
    first = read(COMM, tmp_path / "4b.msh")
    points, cells, _ = in_file_order(first)
    clamped = np.flatnonzero(points[:, 0] == 0.0).tolist()
    for name, kind in files.items():
        body = read(COMM, tmp_path / name)
        found, found_cells, _ = in_file_order(body)
        np.testing.assert_allclose(found, points, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found_cells, cells)
        if kind in ("msh", "inp"):
            assert vertices(body, {"tag": "clamp"}) == clamped
            inside = points[cells].mean(axis=1)[:, 0] < 1.0
            assert cells_of(body, "soft") == np.flatnonzero(inside).tolist()
        if kind in ("msh", "vtk"):
            assert vertices(body, {"tag": 7}) == clamped


# Medit

MMG = f"""MeshVersionFormatted 2

Dimension 3

# what mmg3d 5.7 writes
Vertices
5
{rows(np.c_[TIP, np.zeros(5)])}
Corners
2
1
2
RequiredVertices
1
1
Triangles
2
{rows(np.c_[BASE + 1, [3, 3]])}
RequiredTriangles
1
1
Edges
1
{rows(np.c_[EDGE + 1, [6]])}
Ridges
1
1
RequiredEdges
1
1
Tetrahedra
2
{rows(np.c_[TETRAHEDRA + 1, TAGS])}
Normals
1
0 0 1.e-1
NormalAtVertices
1
2 1
Tangents
1
1 0 0
TangentAtVertices
1
1 1

End
"""
SPELLINGS = {
    "mmg": MMG,
    "after End": MMG + "\n||\nVertices\n7\n",
    "counts on the line": MMG.replace("Vertices\n5\n", "Vertices 5\n").replace(
        "Tetrahedra\n2\n", "Tetrahedra 2\n"
    ),
    "own lines": MMG.replace("MeshVersionFormatted 2", "MeshVersionFormatted\n2").replace(
        "Dimension 3", "Dimension\n3"
    ),
    "real references": MMG.replace(" 4\n", " 4.0\n"),
    "carriage returns": MMG.replace("\n", "\r\n"),
    "no End": MMG.replace("\nEnd\n", ""),
    "empty sections": MMG.replace("Corners\n2\n1\n2\n", "Quadrilaterals\n0\nHexaedra\n0\n"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_medit_spellings(spelling, tmp_path):
    body = read(COMM, put_text(tmp_path / "tip.mesh", SPELLINGS[spelling]))
    check_tip(body)
    assert vertices(body, {"tag": 3}) == [1, 2, 3, 4]
    assert vertices(body, {"tag": 6}) == [1, 2]


BAMG = """MeshVersionFormatted 0
Dimension 2
Identifier
"G=square.bamg;1, Date: 20/1/2 Vertices 12"
Geometry
"square.bamg"
Vertices
4
0 0 1
1 0 2
1 1 3
0 1 4
Edges
4
1 2 11
2 3 12
3 4 13
4 1 14
CrackedEdges
0
Triangles
2
1 2 3 5
1 3 4 7
SubDomainFromMesh
1
3 1 1 1
SubDomainFromGeom
1
2 1 1 1
VertexOnGeometricVertex
1
1 1
VertexOnGeometricEdge
1
2 1 0.5
EdgeOnGeometricEdge
1
1 1
End
"""


def test_what_bamg_writes(tmp_path):
    body = read(COMM, put_text(tmp_path / "square.mesh", BAMG))
    points, cells, tags = in_file_order(body)
    np.testing.assert_array_equal(points, [[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(cells, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(tags, [5, 7])
    assert vertices(body, {"tag": 12}) == [1, 2]
    assert vertices(body, {"tag": 4}) == [3]


# TetGen and Triangle


def tetgen(tmp_path, first: int = 1, attributes=None, markers=(0, 3, 3, 3, 3)):
    """Files of the TIP; both kinds of comments that there are."""
    numbered = np.arange(5) + first
    nodes = "".join(
        f"   {n}    {x[0]}  {x[1]}  {x[2]}{f'  {m}' if markers else ''}\n"
        for n, x, m in zip(numbered, TIP, markers or [0] * 5, strict=True)
    )
    cells = "".join(
        f"{k + first}  {'  '.join(str(v + first) for v in cell)}{f'  {a}' if a else ''}\n"
        for k, (cell, a) in enumerate(zip(TETRAHEDRA, attributes or ["", ""], strict=True))
    )
    put_text(
        tmp_path / "tip.1.node",
        f"# made by hand\n\n5  3  0  {int(bool(markers))}\n{nodes}# Generated by tetgen -pqA\n",
    )
    return put_text(tmp_path / "tip.1.ele", f"2  4  {int(bool(attributes))}\n{cells}# the end\n")


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("attributes", [("4", "9"), ("4.0", "9.000"), ("4e0", "9")])
def test_tetgen_regions_and_markers(first, attributes, tmp_path):
    """Regions as whole or real numbers, counted from 0 or 1; markers of vertices are tags."""
    path = tetgen(tmp_path, first, attributes)
    for file in (path, path.with_suffix(".node")):
        body = read(COMM, file)
        check_tip(body)
        assert vertices(body, {"tag": 3}) == [1, 2, 3, 4]


def test_tetgen_faces_and_edges(tmp_path):
    """With their markers, before which those of vertices stand back; and without any."""
    path = tetgen(tmp_path, 1, ("4", "9"))
    put_text(path.with_suffix(".face"), f"2 1\n{rows(np.c_[BASE + 1, [3, -7]], 1)}")
    put_text(path.with_suffix(".edge"), f"1 1\n{rows(np.c_[EDGE + 1, [6]], 1)}")
    body = read(COMM, path)
    check_tip(body)
    assert vertices(body, {"tag": 3}) == [1, 2, 3]
    assert vertices(body, {"tag": -7}) == [1, 2, 4]
    assert vertices(body, {"tag": 6}) == [1, 2]
    put_text(path.with_suffix(".face"), f"2 0\n{rows(BASE + 1, 1)}")
    assert vertices(read(COMM, path), {"tag": 3}) == [1, 2, 3, 4]


def test_attributes_that_are_no_tags_are_told(tmp_path, caplog):
    body = read(COMM, tetgen(tmp_path, 1, ("0.5", "9")))
    check_tip(body, [0, 0])
    if COMM.rank == 0:
        (record,) = caplog.records
        assert "tip.1.ele: attributes are no whole numbers" in record.getMessage()


def test_what_triangle_writes(tmp_path):
    """The same files in 2D; an .edge has the boundary's markers."""
    put_text(tmp_path / "a.node", "4 2 1 1\n1 0 0 .5 1\n2 1 0 .5 1\n3 1 1 .5 1\n4 0 1 .5 1\n")
    put_text(tmp_path / "a.edge", "5 1\n1 1 2 11\n2 2 3 12\n3 3 4 13\n4 4 1 14\n5 1 3 0\n")
    body = read(COMM, put_text(tmp_path / "a.ele", "2 3 1\n1 1 2 3 5\n2 1 3 4 7\n"))
    points, _, tags = in_file_order(body)
    np.testing.assert_array_equal(points, [[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(tags, [5, 7])
    assert vertices(body, {"tag": 12}) == [1, 2]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("tip.1.ele", "2 4 0\n1 1 2 3 4\n", "tip.1.ele: has 5 numbers, where 2 rows of 5 are due"),
        ("tip.1.ele", "1 4 0\n1 1 2 3 9\n", "names a vertex that the .node file does not list"),
        ("tip.1.ele", "1 4 0\n1 1 2 3 x\n", "tip.1.ele: has something else than numbers"),
        ("tip.1.ele", "1 10 0\n1 1 2 3 4 5 1 2 3 4 5\n", "cells of type tetra10; straight"),
        ("tip.1.node", "\n# nothing\n", "tip.1.node: is empty"),
        ("tip.1.node", "-1 3 0 0\n", "tip.1.node: begins with a negative count"),
    ],
)
def test_tetgen_files_that_are_refused(name, text, message, tmp_path):
    path = tetgen(tmp_path)
    put_text(tmp_path / name, text)
    with pytest.raises(MeshError, match=message):
        read(COMM, path)


def test_tetgen_needs_both_files(tmp_path):
    path = put_text(tmp_path / "alone.ele", "1 4 0\n1 1 2 3 4\n")
    with pytest.raises(MeshError, match=r"needs alone.node beside it, which is not there"):
        read(COMM, path)
