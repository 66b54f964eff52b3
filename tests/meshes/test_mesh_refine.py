"""Uniform refinement: geometry, file order, tags and groups, on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem

from meshes import CELLS, MeshError, Where, box, read, refine
from meshes.quality import quality, volumes
from meshes.raw import collect
from tests.mesh_files import (
    COMM,
    MEDIT,
    SIZE,
    TETRAHEDRA,
    TIP,
    cells_of,
    in_file_order,
    p1,
    sides_file,
    vertices,
    write,
)

BOX = ((1.0, 0.7, 0.5), (3, 2, 2))


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("cell", [*CELLS[2], *CELLS[3]])
def test_a_box_becomes_the_box_of_more_cells(cell, n):
    """The same cells, with the same places of their vertices, in another order."""
    d = 2 if cell in CELLS[2] else 3
    size, cells = BOX[0][:d], BOX[1][:d]
    ours = in_file_order(refine(box(COMM, size, cells, cell), n))
    theirs = in_file_order(box(COMM, size, [2**n * k for k in cells], cell))
    found = [
        {frozenset(map(tuple, np.round(points[corners], 9))) for corners in connectivity}
        for points, connectivity, _ in (ours, theirs)
    ]
    assert found[0] == found[1]


def skew(body):
    """Move the vertices of a box, the same on all ranks."""
    x = body.mesh.geometry.x
    x[:, :2] += 0.05 * np.sin(5 * x[:, :2] + x[:, [2, 0]])
    return body


@pytest.mark.parametrize("cell", [*CELLS[2], *CELLS[3]])
def test_the_documented_order(cell):
    """Vertices keep their numbers; cell c has the children 2ᵈ c and on, which fill it."""
    d = 2 if cell in CELLS[2] else 3
    coarse = skew(box(COMM, BOX[0][:d], BOX[1][:d], cell))
    before, after = collect(coarse), collect(refine(coarse))
    if before is None or after is None:
        return
    np.testing.assert_array_equal(after.points[: len(before.points)], before.points)
    children = volumes(after).reshape(-1, 2**d).sum(axis=1)
    if d == 2 or cell == "tetrahedron":  # faces of hexahedra are not plane
        np.testing.assert_allclose(children, volumes(before), rtol=1e-12)
    middles = after.points[after.cells].mean(axis=1).reshape(-1, 2**d, d).mean(axis=1)
    np.testing.assert_allclose(middles, before.points[before.cells].mean(axis=1), atol=2e-3)
    for child, parent in enumerate(np.repeat(before.cells, 2**d, axis=0)):
        low, high = (f(before.points[parent], axis=0) for f in (np.min, np.max))
        x = after.points[after.cells[child]]
        assert (x >= low - 1e-12).all() and (x <= high + 1e-12).all()
    # New vertices come as the middles of edges first, in the order of their ends.
    ends = after.points[len(before.points)]
    first = np.sort(before.cells[(before.cells == 0).any(axis=1)], axis=1)[:, 1].min()
    np.testing.assert_allclose(ends, before.points[[0, first]].mean(axis=0), atol=1e-14)


def test_repeated_refinement_does_not_flatten_cells():
    """The shortest diagonal: quality stays above a bound however often (Zhang 1995)."""
    body = box(COMM, (1.0, 1.0, 1.0), (1, 1, 1))
    x = body.mesh.geometry.x
    x[:, 0] += 0.6 * x[:, 1]
    x[:, 2] += 0.4 * x[:, 0]
    worst = []
    for n in (0, 1, 2, 3):
        raw = collect(refine(body, n))
        worst.append(COMM.bcast(None if raw is None else float(quality(raw).min())))
    assert min(worst) > 0.4 * worst[0]
    assert worst[3] == pytest.approx(worst[2], rel=1e-9)  # a few shapes, again and again


@pytest.mark.parametrize("cell", MEDIT)
def test_tags_pass_to_the_children(cell, tmp_path):
    """Of cells and facets: regions and sides are where they were."""
    coarse = read(COMM, sides_file(tmp_path / "sides.mesh", cell))
    fine = refine(coarse, 2)
    d = fine.mesh.geometry.dim
    V = fem.functionspace(fine.mesh, ("Lagrange", 2, (d,)))
    expected = fem.locate_dofs_geometrical(V, lambda X: (X[0] < 1e-9) | (X[1] > SIZE[1] - 1e-9))
    np.testing.assert_array_equal(fine.dofs(V, Where(tag=3)), np.sort(expected))
    children = [2 ** (2 * d) * c + k for c in cells_of(coarse, 8) for k in range(2 ** (2 * d))]
    assert cells_of(fine, 8) == children
    points, cells, tags = in_file_order(fine)
    np.testing.assert_array_equal(tags == 8, points[cells].mean(axis=1)[:, 0] < 1.0)


def test_sets_of_vertices_gain_what_lies_between_them(tmp_path):
    """On a side its facets; not the edge through the body between two sides. Lines stay lines."""
    for cell in ("triangle", "tetrahedron"):
        coarse = read(COMM, sides_file(tmp_path / f"{cell}.mesh", cell))
        listed = np.zeros(coarse.num_vertices, dtype=int)
        listed[vertices(coarse, {"tag": 3})] = 5
        raw = collect(coarse)
        path = tmp_path / f"{cell}-2.mesh"
        cells = None if raw is None else raw.cells
        points = None if raw is None else raw.points
        write(path, points, [(MEDIT[cell][0], cells)], point_data={"medit:ref": listed})
        fine = refine(read(COMM, path))
        x, _, _ = in_file_order(fine)
        high = np.array(SIZE[: x.shape[1]])
        found = vertices(fine, {"tag": 5})
        assert ((x[found] == 0) | (x[found] == high)).any(axis=1).all()
        on_sides = np.flatnonzero((x[:, 0] == 0) | (x[:, 1] == SIZE[1]))
        assert set(on_sides) <= set(found)
        if cell == "triangle":
            assert on_sides.tolist() == found

    edge = write(
        tmp_path / "edge.mesh",
        TIP,
        [("tetra", TETRAHEDRA), ("line", np.array([[1, 2]]))],
        cell_data={"medit:ref": [np.array([1, 1]), np.array([6])]},
    )
    fine = refine(read(COMM, edge), 2)
    x, _, _ = in_file_order(fine)
    np.testing.assert_allclose(
        np.sort(x[vertices(fine, {"tag": 6})][:, 0]), [0, 0.25, 0.5, 0.75, 1]
    )


def test_nothing_and_too_much():
    body = box(COMM, (1.0, 1.0), (2, 2))
    assert refine(body, 0) is body
    with pytest.raises(MeshError, match="refine: must be 0 or more times, not -1"):
        refine(body, -1)
    with pytest.raises(MeshError, match=r"refine: 30 times would make more than 1e.09 cells"):
        refine(body, 30)
    assert p1(refine(body)).dofmap.index_map.size_global == 25
