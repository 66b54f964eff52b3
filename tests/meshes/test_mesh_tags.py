"""Parts of a body by tag: degrees of freedom, facets, measures, cells; values in file order."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import entities_to_geometry

from forms import BackwardEuler, StableNeoHookean, mixed_fields, symmetric
from meshes import CELLS, Body, MeshError, Where, box, read
from solvers import SOLVERS, MixedProblem
from tests.mesh_files import COMM, COUNT, MEDIT, SIZE, p1, sides_file, vertices


def between(body: Body, V: fem.FunctionSpace, chosen: list[int]) -> np.ndarray:
    """Degrees of freedom of entities of any kind all of whose vertices are among some."""
    found = []
    for dim in range(body.mesh.topology.dim + 1):
        body.mesh.topology.create_entities(dim)
        body.mesh.topology.create_connectivity(dim, body.mesh.topology.dim)
        every = np.arange(body.mesh.topology.index_map(dim).size_local, dtype=np.int32)
        nodes = entities_to_geometry(body.mesh, dim, every)
        numbers = body.mesh.geometry.input_global_indices[nodes]
        entities = every[np.isin(numbers, chosen).all(axis=1)]
        found.append(fem.locate_dofs_topological(V, dim, entities))
    return np.unique(np.concatenate(found))


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", MEDIT)
def test_sides_that_meet_hold_nothing_inside(cell, degree, tmp_path):
    """The degrees of freedom of two sides with one tag are those on the sides, found by place.

    An edge between them goes through the inside of a triangle or tetrahedron at the corner.
    """
    body = read(COMM, sides_file(tmp_path / "sides.mesh", cell))
    d = body.mesh.geometry.dim
    V = fem.functionspace(body.mesh, ("Lagrange", degree, (d,)))
    expected = fem.locate_dofs_geometrical(V, lambda X: (X[0] < 1e-9) | (X[1] > SIZE[1] - 1e-9))
    np.testing.assert_array_equal(body.dofs(V, Where.parse({"tag": 3})), np.sort(expected))

    # Listed vertices mean facets of the boundary, too. In 3D that may be a facet of another side,
    # all of whose vertices are in the set.
    listed = vertices(body, {"tag": 3})
    found = body.dofs(V, Where.parse({"vertices": listed}))
    assert set(expected) <= set(found)
    x = V.tabulate_dof_coordinates()[:, :d]
    outside = ((x < 1e-9) | (x > np.array(SIZE[:d]) - 1e-9)).any(axis=1)
    assert outside[found].all()
    if cell in ("triangle", "tetrahedron") and degree == 2:
        inside = ~outside[between(body, V, listed)]
        assert COMM.allreduce(int(inside.sum())) > 0  # what the rule is there to leave out


@pytest.mark.parametrize("cell", MEDIT)
def test_a_measure_covers_its_facets(cell, tmp_path):
    """Area, first moment and normal of tagged sides; sides may overlap in one form."""
    body = read(COMM, sides_file(tmp_path / "sides.mesh", cell, inner=True))
    d = body.mesh.geometry.dim
    depth = SIZE[2] if d == 3 else 1.0
    x, n = ufl.SpatialCoordinate(body.mesh), ufl.FacetNormal(body.mesh)
    both, right = body.ds(Where(tag=3)), body.ds(Where(tag=6))
    place = body.ds(Where(extents=(("x", "min"),)))

    def total(form):
        return COMM.allreduce(fem.assemble_scalar(fem.form(form)))

    one = fem.Constant(body.mesh, 1.0)
    assert total(one * both) == pytest.approx((SIZE[0] + SIZE[1]) * depth, rel=1e-13)
    assert total(x[1] * right) == pytest.approx(SIZE[1] ** 2 / 2 * depth, rel=1e-13)
    assert total(n[0] * right) == pytest.approx(SIZE[1] * depth, rel=1e-13)
    mixed = 2 * one * both + 30 * one * place + 400 * one * right + 5000 * one * body.ds()
    around = 2 * (SIZE[0] + SIZE[1]) * depth + (2 * SIZE[0] * SIZE[1] if d == 3 else 0.0)
    expected = (2 * SIZE[0] + (2 + 30 + 400) * SIZE[1]) * depth + 5000 * around
    assert total(mixed) == pytest.approx(expected, rel=1e-13)
    assert body.ds(Where(tag=3)).subdomain_id() == both.subdomain_id()


def test_a_part_of_a_tagged_side(tmp_path):
    """A tag and a place: the tagged facets whose vertices are there."""
    body = read(COMM, sides_file(tmp_path / "sides.mesh", "tetrahedron"))
    where = Where.parse({"tag": 3, "y": "max"})
    area = fem.form(fem.Constant(body.mesh, 1.0) * body.ds(where))
    assert COMM.allreduce(fem.assemble_scalar(area)) == pytest.approx(2.0, rel=1e-13)
    points = body.gather_points(everywhere=True)
    assert vertices(body, {"tag": 3, "y": "max"}) == np.flatnonzero(points[:, 1] == 1.5).tolist()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_a_traction_gives_its_impulse(cell, solver, tmp_path):
    """A free body pulled at a tagged side: its momentum is force times time."""
    body = read(COMM, sides_file(tmp_path / "sides.mesh", cell))
    d = body.mesh.geometry.dim
    u, S, Y = mixed_fields(body.mesh)
    euler = BackwardEuler(u, 0.2, (0.0,) * d)
    traction = fem.Constant(body.mesh, np.array([3.0, -1.0, 0.5])[:d])
    psi = StableNeoHookean(200.0, 0.3)
    energy = (symmetric(u, S, Y, psi) + euler.kinetic(2.0)) * ufl.dx
    energy -= ufl.inner(traction, u) * body.ds(Where(tag=6))
    MixedProblem(energy, (u, S, Y), [], solver=solver).solve()
    area = SIZE[1] * (SIZE[2] if d == 3 else 1.0)
    for i in range(d):
        momentum = COMM.allreduce(fem.assemble_scalar(fem.form(2.0 * u[i] / 0.2 * ufl.dx)))
        assert momentum == pytest.approx(traction.value[i] * area * 0.2, rel=1e-9)


def test_what_has_no_facets_is_told(tmp_path):
    body = read(COMM, sides_file(tmp_path / "sides.mesh", "tetrahedron"))
    with pytest.raises(MeshError, match=r"vertices = .0, 5. } holds no facet of the boundary"):
        body.ds(Where(vertices=(0, 5)))
    with pytest.raises(MeshError, match=r"y = .1.7, 2., tag = 6 } holds no entity; the mesh sp"):
        body.ds(Where(tag=6, extents=(("y", (1.7, 2.0)),)))
    # 8 tags cells alone: as a boundary that is a mistake
    with pytest.raises(MeshError, match="tag = 8 }: the mesh has no such tag; tags: 3, 6"):
        body.dofs(p1(body), Where(tag=8))


# Cells


def test_untagged_cells_are_those_of_tag_0(tmp_path):
    """Beside tagged ones, as a region of their own."""
    body = read(COMM, sides_file(tmp_path / "sides.mesh", "triangle"))
    assert body.tagged_cells() == [0, 8]
    middles = body.gather_points(everywhere=True)
    middles = middles[body.gather(body.file_connectivity(), everywhere=True)].mean(axis=1)
    regions = body.regions([0, 8])
    found = body.gather(regions.values[: len(body.file_cells)], everywhere=True)
    np.testing.assert_array_equal(found, middles[:, 0] < 1.0)
    for tags, message in (
        ([8], r"cell \d+ .from 0. is tagged none of 8"),
        ([0, 8, 8], r"cell \d+ .from 0. is tagged both 8 and 8"),
        ([0, 8, "soft"], "no cell is tagged soft"),
    ):
        with pytest.raises(MeshError, match=message):
            body.regions(tags)


# Values in file order


@pytest.fixture(params=MEDIT)
def any_body(request) -> Body:
    """A body of each kind of cells."""
    d = 2 if request.param in CELLS[2] else 3
    return box(COMM, SIZE[:d], COUNT[:d], request.param)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gathered_values_are_those_at_the_vertices(any_body, degree):
    """Of a function of any degree, a vector or a number."""
    points = any_body.gather_points(everywhere=True)
    d = points.shape[1]
    V = fem.functionspace(any_body.mesh, ("Lagrange", degree, (d,)))
    f = fem.Function(V)
    f.interpolate(lambda X: np.array([X[0] ** degree, X[1] - X[0], X[0] * 0 + 7.0])[:d])
    expected = np.stack([points[:, 0] ** degree, points[:, 1] - points[:, 0], 0 * points[:, 0] + 7])
    found = any_body.gather(f, everywhere=True)
    np.testing.assert_allclose(found, expected[:d].T, rtol=0, atol=1e-13)
    alone = any_body.gather(f.sub(0).collapse())
    if COMM.rank == 0:
        np.testing.assert_allclose(alone, expected[0], rtol=0, atol=1e-13)
    else:
        assert alone is None


def test_put_is_the_way_back(any_body):
    """At vertices and in cells, tensors included; ghosts as their owners."""
    d = any_body.mesh.geometry.dim
    rng = np.random.default_rng(3)
    for element, size in (
        (("Lagrange", 1, (d,)), any_body.num_vertices * d),
        (("DG", 0), any_body.num_cells),
        (("DG", 0, (d, d)), any_body.num_cells * d * d),
        (("DG", 0, (d, d), True), any_body.num_cells * d * (d + 1) // 2),
    ):
        f = fem.Function(fem.functionspace(any_body.mesh, element))
        values = COMM.bcast(rng.standard_normal(size))
        any_body.put(f, values)
        np.testing.assert_array_equal(any_body.gather(f, everywhere=True).ravel(), values)
        owned = f.x.array.copy()
        f.x.scatter_forward()
        np.testing.assert_array_equal(f.x.array, owned)
        with pytest.raises(ValueError, match=f"{size - 1} values are given for f"):
            any_body.put(f, values[1:])


def test_the_values_of_cells_are_their_own(any_body):
    """A DG0 function of place and a plain array of it agree."""
    middle = fem.functionspace(any_body.mesh, ("DG", 0))
    f = fem.Function(middle)
    f.interpolate(lambda X: X[0] + 10 * X[1])
    owned = f.x.array[middle.dofmap.list[: len(any_body.file_cells), 0]]
    cells = any_body.gather(any_body.file_connectivity(), everywhere=True)
    x = any_body.gather_points(everywhere=True)[cells].mean(axis=1)
    for found in (any_body.gather(f, everywhere=True), any_body.gather(owned, everywhere=True)):
        np.testing.assert_allclose(found, x[:, 0] + 10 * x[:, 1], rtol=0, atol=1e-13)


def test_values_that_are_at_no_vertex(any_body):
    V = fem.functionspace(any_body.mesh, ("DG", 1))
    with pytest.raises(ValueError, match="a continuous Lagrange space"):
        any_body.gather(fem.Function(V))
    with pytest.raises(ValueError, match="continuous piecewise linear"):
        any_body.put(fem.Function(V), np.zeros(1))
