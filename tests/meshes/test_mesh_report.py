"""`mixed-fem mesh`: what a file holds and what is wrong with it; parts that nothing joins."""

from __future__ import annotations

import json

import meshio
import numpy as np
import pytest
from dolfinx.mesh import CellType

from demos.app.cli import main
from meshes import MeshError, Where, box, connected_parts, read, refine, told_parts
from meshes.interfaces import doubtful
from meshes.quality import quality, volumes
from meshes.raw import RawMesh, collect
from meshes.report import report
from tests.mesh_files import COMM, TETRAHEDRA, TIP, sides_file, write


@pytest.fixture
def told(capsys, tmp_path):
    """Write a mesh on rank 0, run the command, return exit code, output and errors of rank 0."""

    def run(points, cells, *arguments, name="mesh.vtu", **kwargs):
        points = np.pad(points, ((0, 0), (0, 3 - np.shape(points)[1])))  # as VTU has them
        path = write(tmp_path / name, points, cells, **kwargs)
        code = main(["mesh", str(path), *arguments])
        return code, *COMM.bcast(tuple(capsys.readouterr()))

    return run


TETS = [("tetra", TETRAHEDRA)]


def test_figures_of_a_mesh(tmp_path, capsys):
    """Counts, extents, volume, sizes, groups; lengths in the unit asked for."""
    path = sides_file(tmp_path / "sides.mesh", "tetrahedron")
    assert main(["mesh", str(path), "--json", "--scale", "0.001"]) == 0
    out, err = COMM.bcast(tuple(capsys.readouterr()))
    assert err == ""
    found = json.loads(out)
    assert (found["vertices"], found["cells"], found["dimension"]) == (5 * 4 * 3, 6 * 4 * 3 * 2, 3)
    assert found["cell"] == "tetrahedron" and found["usable"] and found["problems"] == []
    np.testing.assert_allclose([found["low"], found["high"]], [[0] * 3, [0.002, 0.0015, 0.001]])
    assert found["volume"] == pytest.approx(3e-9, rel=1e-12)
    diagonal = 0.001 * np.sqrt(0.5**2 + 0.5**2 + 0.5**2)
    assert found["h"] == {k: pytest.approx(diagonal, rel=1e-12) for k in ("min", "mean", "max")}
    groups = {(g["tag"], g["entities"]): g["count"] for g in found["groups"]}
    assert groups == {(3, "facets"): 2 * (3 * 2 + 4 * 2), (6, "facets"): 12, (8, "cells"): 72}
    assert found["untagged"] == 72
    assert len(found["parts"]) == 1


def test_text_is_for_people(told):
    code, out, err = told(TIP, TETS, cell_data={"region": [np.array([4, 0])]})
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert "2 cells (tetrahedron), 5 vertices, 3D" in lines[0]
    assert any("radius ratio (3 r / R" in line for line in lines)
    assert any(line.endswith("4: 1 cell") for line in lines)
    assert any("0: 1 cell without a tag" in line for line in lines)
    assert lines[-1].strip() == "nothing is wrong with it"


def test_the_worst_cells_are_named(told):
    """By their numbers, the flattest first."""
    points = np.vstack([TIP, [[0.2, 0.3, 0.01]], [[0.2, 0.3, -0.2]]])
    cells = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [6, 1, 2, 3], [6, 1, 2, 4]])
    cells = np.vstack([cells[:2], cells[2:]])
    points[5] = [2.0, 0.5, 0.0]
    cells = np.vstack([cells, [[0, 1, 3, 5]]])
    _, out, _ = told(points, [("tetra", cells)], "--json")
    found = json.loads(out)
    values = [value for _, value in found["worst"]]
    assert values == sorted(values) and found["quality"]["min"] == values[0]
    assert {cell for cell, _ in found["worst"][:2]} == {2, 3}


# What is wrong. Each: points, cells, and the names of the problems.
STACK = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
CUBE = np.vstack([STACK, STACK + np.array([0, 0, 1])])
BRICK, RIGHT = np.arange(8), np.array([1, 0, 0])
SQUARE = STACK[:, :2]
WRONG = {
    # two cubes meshed apart, with the vertices of their interface twice
    "unmerged": (np.vstack([CUBE, CUBE + RIGHT]), "hexahedron", [BRICK, BRICK + 8]),
    # a cube on four, meshed apart
    "not matching": (
        np.vstack([CUBE, 0.5 * CUBE + RIGHT]),
        *("hexahedron", [BRICK, BRICK + 8]),
    ),
    # a vertex in the middle of an edge of a cell that does not have it
    "hanging": (
        np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2, 0], [1, 0.5], [2, 0.5], [2, 1.0]]),
        *("quad", [[0, 1, 2, 3], [1, 4, 6, 5], [5, 6, 7, 2]]),
    ),
    "hinge": (
        np.vstack([SQUARE, SQUARE[1:] + 1]),
        *("quad", [[0, 1, 2, 3], [2, 4, 5, 6]]),
    ),
    "twice": (TIP, "tetra", [*TETRAHEDRA, TETRAHEDRA[0][[1, 0, 2, 3]]]),
    "unused": (np.vstack([TIP, [[5, 5, 5]]]), "tetra", TETRAHEDRA),
    "all at once": (
        np.vstack([TIP, [[5, 5, 5]], TIP + 9 * RIGHT]),
        "tetra",
        [*TETRAHEDRA, TETRAHEDRA[0], [1, 2, 3, 4], *(TETRAHEDRA + 6)],
    ),
}
NAMES = {
    "unmerged": ["several parts", "unmerged interface"],
    "not matching": ["several parts", "unmerged interface", "unmerged interface"],
    "hanging": ["hanging nodes", "hinges"],  # the small squares share single vertices
    "hinge": ["hinges"],
    "twice": ["duplicate cells"],
    "unused": ["unused vertices"],
    "all at once": ["unused vertices", "degenerate cells", "duplicate cells", "several parts"],
}
COUNTS = {
    "unmerged": [2, 8],
    "not matching": [2, 2, 3],
    "hanging": [1, 0],
    "hinge": [0],
    "twice": [1],
    "unused": [1],
    "all at once": [1, 1, 1, 2],
}


@pytest.mark.parametrize("case", WRONG)
def test_all_that_is_wrong_is_told(case, told, tmp_path):
    """Whole and by number; `read` refuses with one of the lines what cannot be used."""
    points, kind, cells = WRONG[case]
    code, out, err = told(points, [(kind, np.array(cells))], "--json")
    found = json.loads(out)
    assert err == ""
    assert [p["name"] for p in found["problems"]] == NAMES[case]
    assert [p["count"] for p in found["problems"]] == COUNTS[case]
    fatal = [p for p in found["problems"] if p["unusable"]]
    assert code == (2 if fatal else 0) and found["usable"] == (not fatal)
    if fatal:
        with pytest.raises(MeshError) as error:
            read(COMM, tmp_path / "mesh.vtu")
        assert str(error.value) == f"{tmp_path / 'mesh.vtu'}: {fatal[0]['message']}"
    else:
        assert read(COMM, tmp_path / "mesh.vtu").num_cells == len(cells)
    code_again, out, _ = told(points, [(kind, np.array(cells))])
    assert code_again == code
    for problem in found["problems"]:
        assert problem["message"] in out


def test_tagged_facets_that_no_cell_has(told):
    """Those of the base that are facets are found; one across it is not."""
    base = np.array([[1, 2, 3], [1, 3, 4]])
    data = {"medit:ref": [np.array([4, 9]), np.array([3, 3])]}
    cells = [("tetra", TETRAHEDRA), ("triangle", base)]
    code, out, _ = told(TIP, cells, "--json", name="mesh.mesh", cell_data=data)
    (problem,) = json.loads(out)["problems"]
    assert (code, problem["name"]) == (0, "tagged facets of no cell")
    assert problem["numbers"] == [1, 3, 4]


def test_where_hanging_nodes_and_interfaces_are(told):
    points, kind, cells = WRONG["hanging"]
    _, out, _ = told(points, [(kind, np.array(cells))], "--json")
    assert json.loads(out)["problems"][0]["numbers"] == [5]
    points, kind, cells = WRONG["not matching"]
    _, out, _ = told(points, [(kind, np.array(cells))], "--json")
    # 1 and 8 are in one place; three vertices of the small cube lie on a face of the large one
    assert [p["numbers"] for p in json.loads(out)["problems"][1:]] == [[1, 8], [11, 12, 15]]


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_a_hanging_node_in_any_cell(cell):
    """One cell of a box refined, the others not: its new vertices hang on them."""
    d = 2 if cell in ("triangle", "quadrilateral") else 3
    body = box(COMM, (2.0, 1.0, 1.0)[:d], (2, 1, 1)[:d], cell)
    coarse, fine = collect(body), collect(refine(body))
    if coarse is None or fine is None:
        return
    kept = np.vstack([fine.cells[: 2**d], coarse.cells[1:]])
    used, places = np.unique(kept, return_inverse=True)
    raw = RawMesh(
        coarse.kind, fine.points[used], places.reshape(kept.shape), np.zeros(len(kept), int)
    )
    new = np.flatnonzero(used >= len(coarse.points))
    inner = [v for v in new if on_a_neighbour(raw.points[v], coarse, d)]
    (hanging,) = (p.numbers.tolist() for p in doubtful(raw) if p.name == "hanging nodes")
    assert hanging == inner and len(inner) > 0
    for body in (coarse, fine):
        assert not list(doubtful(body))


def on_a_neighbour(x, coarse, d) -> bool:
    """Whether a point lies in another cell than the first of a box, which is convex."""
    for corners in coarse.cells[1:]:
        y = coarse.points[corners]
        if len(corners) == d + 1:
            share = np.linalg.solve(np.vstack([y.T, np.ones(d + 1)]), np.append(x, 1.0))
            if (share > -1e-12).all():
                return True
        elif (x > y.min(axis=0) - 1e-12).all() and (x < y.max(axis=0) + 1e-12).all():
            return True
    return False


def test_quality_of_known_cells():
    """1 for equilateral and rectangular cells; a known value; 0 for flat ones."""
    up = np.sqrt(3) / 2
    equilateral = np.array([[0, 0], [1, 0], [0.5, up]])
    right = np.array([[0, 0], [1, 0], [0, 1.0]])

    def one(kind, points):
        raw = RawMesh(kind, points, np.arange(len(points))[None], np.zeros(1, dtype=np.int32))
        return float(quality(raw)[0]), float(volumes(raw)[0])

    assert one(CellType.triangle, equilateral) == pytest.approx((1.0, up / 2))
    # r = (2 - √2) / 2 and R = √2 / 2
    assert one(CellType.triangle, right) == pytest.approx((2 * (2 - np.sqrt(2)) / np.sqrt(2), 0.5))
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    assert one(CellType.tetrahedron, regular) == pytest.approx((1.0, 8 / 3))
    corner = np.vstack([np.zeros(3), np.eye(3)])
    # r = 1 / (3 + √3), R = √3 / 2
    value = 3 * 2 / ((3 + np.sqrt(3)) * np.sqrt(3))
    assert one(CellType.tetrahedron, corner) == pytest.approx((value, 1 / 6))
    assert one(CellType.tetrahedron, corner * [1, 1, 0])[0] == 0.0
    slanted = np.array([[0, 0], [1, 0], [np.cos(1), np.sin(1)], [1 + np.cos(1), np.sin(1)]])
    assert one(CellType.quadrilateral, slanted) == pytest.approx((np.sin(1), np.sin(1)))
    brick = np.array([[x, 2 * y, 3 * z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    assert one(CellType.hexahedron, brick) == pytest.approx((1.0, 6.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent.msh"], "absent.msh: no such file"),
        (["absent.msh", "--scale", "0"], "absent.msh: scale must be above 0, not 0.0"),
        ([], "the following arguments are required: FILE"),
    ],
)
def test_files_that_cannot_be_looked_into(arguments, message, capsys):
    """One line, exit code 2."""
    assert main(["mesh", *arguments]) == 2
    out, err = COMM.bcast(tuple(capsys.readouterr()))
    assert out == "" and message in err and err.count("\n") == 1


def test_a_report_is_refused_where_there_is_nothing_to_report(tmp_path):
    path = write(tmp_path / "line.vtu", TIP, [("line", np.array([[0, 1]]))])
    with pytest.raises(MeshError, match="has no cells"):
        report(path)


# Parts


def test_parts_on_any_number_of_ranks(tmp_path):
    """Three strips of which two lie on each other; the clauses hold one of them."""
    strip = collect(box(COMM, (4.0, 1.0), (16, 4)))
    path = tmp_path / "strips.vtu"
    if strip is not None:
        points = np.vstack([strip.points + np.array([0, k]) for k in (0.0, 1.0, 3.0)])
        cells = np.vstack([strip.cells + k * len(strip.points) for k in range(3)])
        order = np.random.default_rng(0).permutation(len(cells))
        meshio.Mesh(points, [("triangle", cells[order])]).write(path)
        middles = points[cells[order]].mean(axis=1)
    COMM.barrier()
    body = read(COMM, path)
    parts = connected_parts(body, [Where.parse({"y": "max"})])
    assert COMM.allgather(parts) == [parts] * COMM.size
    assert [part.cells for part in parts] == [128] * 3
    assert [part.first for part in parts] == sorted(part.first for part in parts)
    if strip is not None:
        for part in parts:
            inside = (middles > part.low).all(axis=1) & (middles < part.high).all(axis=1)
            assert np.flatnonzero(inside)[0] == part.first
    assert sorted((part.low[1], part.held) for part in parts) == [(0, False), (1, False), (3, True)]
    line = told_parts(parts)
    assert "in 3 parts that share no vertex" in line and line.count("nothing holds part") == 2
    held = connected_parts(body, [Where.parse({"x": "min"})])
    assert all(part.held for part in held)
    assert "hold each of them" in told_parts(held)
    assert told_parts(connected_parts(box(COMM, (1.0, 1.0), (2, 2)))) == ""
