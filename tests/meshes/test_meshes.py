"""Meshes: file order on any number of ranks, vertex sets, and what is refused."""

from __future__ import annotations

from itertools import product

import basix.ufl
import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import create_mesh, entities_to_geometry

from forms import mixed_fields
from meshes import CELLS, MeshError, Where, box, read
from tests.mesh_files import (
    BOX16,
    COMM,
    TETRAHEDRA,
    TIP,
    in_file_order,
    p1,
    put_text,
    vertices,
    write,
)


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


@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_planes_of_a_thin_body(shift):
    """Its sides are told apart, wherever it is and however long."""
    body = box(COMM, (1000.0, 4e-4), (4, 1))
    body.mesh.geometry.x[:, :2] += shift
    points, _, _ = in_file_order(body)
    low = np.flatnonzero(points[:, 1] == points[:, 1].min()).tolist()
    assert vertices(body, {"y": "min"}) == low and len(low) == 5


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
        ("noise.mesh", "Lorem ipsum\ndolor", "is no Medit file: it does not begin with Mesh"),
        (
            "cut.mesh",
            "MeshVersionFormatted 2\nDimension 3\nVertices\n4\n0 0 0",
            "has 3 numbers under Vertices, where 4 rows of 4 are due",
        ),
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
    if text is not None:
        put_text(path, text)
    with pytest.raises(MeshError, match=message) as error:
        read(COMM, path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "quadrilateral"])
def test_curved_cells_are_refused(cell):
    """On them F is not constant; a straight mesh of the same cells is taken."""
    d = 3 if cell == "tetrahedron" else 2
    straight = box(COMM, (1.0,) * d, (2,) * d, cell).mesh
    assert mixed_fields(straight)[0].function_space.mesh is straight
    V = fem.functionspace(straight, ("Lagrange", 2, (d,)))
    x = V.tabulate_dof_coordinates()[:, :d]
    owned = straight.topology.index_map(d).size_local
    numbers = V.dofmap.index_map.local_to_global(V.dofmap.list[:owned].ravel())
    curved = create_mesh(
        COMM,
        numbers.reshape(owned, -1),
        basix.ufl.element("Lagrange", cell, 2, shape=(d,)),
        x[: V.dofmap.index_map.size_local],
    )
    with pytest.raises(ValueError, match=r"has curved cells .geometry of degree 2.; it must have"):
        mixed_fields(curved)


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
