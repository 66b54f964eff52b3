"""Named geometries: what they fill, their groups, their cells, and that they stay the same."""

from __future__ import annotations

import builtins
import signal

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem

from demos.app.scene import parse
from demos.app.simulation import build_body
from meshes import GEOMETRIES, Body, MeshError, Where, connected_parts, geometry, refine
from meshes.geometries import solid
from meshes.interfaces import doubtful
from meshes.quality import quality, volumes
from meshes.raw import collect
from tests.mesh_files import COMM, cells_of, in_file_order, vertices

try:
    import gmsh
except (ImportError, OSError) as error:  # the wheel loads libraries of X11 and OpenGL
    pytest.skip(f"gmsh cannot be loaded ({error})", allow_module_level=True)


@pytest.fixture(scope="module")
def bodies() -> dict[str, Body]:
    """Each geometry with its own size of elements."""
    return {name: geometry(COMM, name) for name in GEOMETRIES}


def area(body: Body, name: str) -> float:
    """Of a group of facets."""
    form = fem.form(fem.Constant(body.mesh, 1.0) * body.ds(Where(tag=name)))
    return float(COMM.allreduce(fem.assemble_scalar(form)))


def volume(body: Body, group: str | None = None) -> float:
    """Of all cells, or of those of a group."""
    raw = collect(body)
    values = None if raw is None else volumes(raw)
    chosen = slice(None) if group is None else cells_of(body, group)
    return float(COMM.bcast(None if values is None else values[chosen].sum()))


@pytest.mark.serial
@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_cells_are_sound(name, bodies):
    """In one piece, without double vertices or flat cells, and all in a group."""
    body = bodies[name]
    assert body.mesh.geometry.dim == GEOMETRIES[name].d
    assert len(connected_parts(body)) == 1
    assert 0 not in body.tagged_cells()
    told = GEOMETRIES[name].description.split("groups: ")[1]
    names = [word.split(" (")[0] for word in told.split(", ")]
    assert set(names) == {tag for tag in body.groups if isinstance(tag, str)}
    raw = collect(body)
    if raw is not None:
        assert quality(raw).min() > 0.1
        assert not list(doubtful(raw))


@pytest.mark.parametrize("name", ["perforated-plate", "gear"])
def test_the_same_mesh_each_time_and_on_any_ranks(name, bodies):
    """To the last bit; h is the size of an element."""
    alone = geometry(MPI.COMM_SELF, name)
    points, cells, _ = in_file_order(bodies[name])
    np.testing.assert_array_equal(alone.gather_points(), points)
    np.testing.assert_array_equal(alone.gather(np.sort(alone.file_connectivity())), cells)
    finer = geometry(COMM, name, 0.5 * GEOMETRIES[name].h)
    assert finer.num_cells > 1.5 * alone.num_cells


@pytest.mark.serial
def test_gmsh_is_silent_and_leaves_no_trace(capfd, bodies):
    """Nothing on the terminal, Ctrl-C as before, and the user's own model with its options."""
    handler = signal.getsignal(signal.SIGINT)
    geometry(COMM, "bear", 0.2)
    assert capfd.readouterr() == ("", "")
    assert signal.getsignal(signal.SIGINT) is handler
    assert not gmsh.isInitialized()
    gmsh.initialize(interruptible=False)
    try:
        gmsh.model.add("mine")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.125)
        geometry(COMM, "perforated-plate")
        assert gmsh.model.getCurrent() == "mine" and "mine" in gmsh.model.list()
        assert gmsh.option.getNumber("Mesh.MeshSizeMax") == 0.125
    finally:
        gmsh.finalize()


@pytest.mark.serial
def test_cooks_membrane(bodies):
    """A trapezium: exactly. Its corner is the point of the published deflections."""
    body = bodies["cooks-membrane"]
    assert volume(body) == pytest.approx(48 * (44 + 16) / 2, rel=1e-13)
    assert area(body, "left") == pytest.approx(44.0) and area(body, "right") == pytest.approx(16.0)
    points, _, _ = in_file_order(body)
    assert (points[vertices(body, {"tag": "left"})][:, 0] == 0.0).all()
    assert np.abs(points - [48.0, 60.0]).max(axis=1).min() == 0.0
    assert np.abs(points - [48.0, 52.0]).max(axis=1).min() < 1e-12
    assert body.num_cells == 2 * 16**2
    assert geometry(COMM, "cooks-membrane", 11.0).num_cells == 2 * 4**2


def converges(exact: float, *bodies: Body, group: str | None = None) -> None:
    """The volume tends to that of the curved body, with the square of the size of elements."""
    errors = [abs(volume(body, group) - exact) for body in bodies]
    assert errors[0] < 0.06 * exact
    assert errors[-1] < 0.3 * errors[0]


@pytest.mark.serial
def test_perforated_plate(bodies):
    radius = 0.25
    fine = geometry(COMM, "perforated-plate", 0.04)
    converges(8.0 - 8 * np.pi * radius**2, bodies["perforated-plate"], fine)
    assert area(fine, "holes") == pytest.approx(8 * 2 * np.pi * radius, rel=2e-3)
    assert area(fine, "left") == pytest.approx(2.0, rel=1e-12)
    one = geometry(COMM, "perforated-plate", columns=1, rows=1, radius=0.4)
    assert volume(one) == pytest.approx(1 - np.pi * 0.4**2, rel=0.06)


@pytest.mark.serial
def test_fibre_beam(bodies):
    """The matrix fills what the fibres leave; these go from end to end."""
    body = bodies["fibre-beam"]
    fibres = 4 * np.pi * 0.15**2 * 4.0
    assert volume(body) == pytest.approx(4.0, rel=1e-12)
    assert volume(body, "fibres") == pytest.approx(fibres, rel=0.06)
    assert volume(body, "matrix") == pytest.approx(4.0 - volume(body, "fibres"), rel=1e-12)
    assert [cells_of(body, k) for k in (1, 2)] == [cells_of(body, k) for k in ("matrix", "fibres")]
    assert area(body, "left") == pytest.approx(1.0) and area(body, "right") == pytest.approx(1.0)
    with pytest.raises(
        MeshError, match=r"geometry fibre-beam: radius = 0.3: 2 fibres do not fit in"
    ):
        geometry(COMM, "fibre-beam", radius=0.3)


@pytest.mark.serial
def test_strut(bodies):
    """Bowing it keeps its volume; its middle is lifted by a thousandth of its length."""
    body = bodies["strut"]
    assert volume(body) == pytest.approx(np.pi * 0.025**2, rel=0.03)
    straight = geometry(COMM, "strut", bow=0.0)
    assert volume(body) == pytest.approx(volume(straight), rel=1e-4)
    lift = (in_file_order(body)[0] - in_file_order(straight)[0])[:, 1]
    x = in_file_order(body)[0][:, 0]
    np.testing.assert_allclose(lift, 0.001 * np.sin(np.pi * x), atol=2e-4)
    assert area(body, "left") == pytest.approx(np.pi * 0.025**2, rel=0.03)


@pytest.mark.serial
def test_gear(bodies):
    """The area of its outline, by the shoelace formula, without the bore, times its thickness."""
    outline = np.array(solid.gear_profile(12, 0.8, 1.0))
    x, y = outline.T
    shoelace = float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)
    exact = 0.25 * (shoelace - np.pi * 0.3**2)
    converges(exact, bodies["gear"], geometry(COMM, "gear", 0.06))
    flank = 0.25 * np.linalg.norm(outline[2] - outline[3])
    assert area(bodies["gear"], "flank") == pytest.approx(flank, rel=1e-12)
    lengths = np.linalg.norm(outline - np.roll(outline, -1, axis=0), axis=1)
    assert area(bodies["gear"], "teeth") == pytest.approx(0.25 * lengths.sum(), rel=1e-12)


@pytest.mark.serial
def test_bear(bodies):
    """Its volume by another route: the share of a fine grid's points in a sphere or cylinder."""
    step = 0.0125
    axes = [
        np.arange(low + step / 2, high, step) for low, high in ((-0.7, 0.7), (0, 1.4), (-0.5, 0.5))
    ]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.zeros(len(x), dtype=bool)
    for centre, radius in solid.BEAR_SPHERES:
        inside |= ((x - centre) ** 2).sum(axis=1) < radius**2
    for end, axis, radius in solid.BEAR_CYLINDERS:
        along = (x - end) @ axis / np.dot(axis, axis)
        away = ((x - end - along[:, None] * np.array(axis)) ** 2).sum(axis=1)
        inside |= (along > 0) & (along < 1) & (away < radius**2)
    exact = inside.sum() * step**3
    errors = [volume(body) / exact - 1 for body in (bodies["bear"], geometry(COMM, "bear", 0.05))]
    assert -0.06 < errors[0] < errors[1] < 0.0 and errors[1] > -0.05
    points, _, _ = in_file_order(bodies["bear"])
    assert points[:, 1].min() == pytest.approx(0.0, abs=1e-9)
    soles = points[vertices(bodies["bear"], {"tag": "feet"})]
    assert np.abs(soles[:, 1]).max() < 1e-9
    assert area(bodies["bear"], "feet") == pytest.approx(2 * np.pi * 0.12**2, rel=0.08)


SCENE = """
[mesh]
geometry = "gear"
{}

[[material]]
name = "stable-neo-hookean"
E = 1e6
nu = 0.4
rho = 1000.0

[[boundary]]
where = {{ tag = "bore" }}
motion = "fixed"

[time]
h = 0.1
steps = 1
"""


def test_a_scene_names_a_geometry(bodies, tmp_path):
    """With its size, refined, and in other units."""
    plain = build_body(parse(SCENE.format(""), tmp_path / "gear.toml"), COMM)
    assert plain.num_cells == bodies["gear"].num_cells
    keys = "h = 0.3\nrefine = 1\nscale = 0.01"
    small = build_body(parse(SCENE.format(keys), tmp_path / "gear.toml"), COMM)
    coarse = geometry(COMM, "gear", 0.3)
    assert small.num_cells == 8 * coarse.num_cells
    assert volume(small) == pytest.approx(1e-6 * volume(refine(coarse)), rel=1e-12)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        (
            "gaer",
            {},
            "geometry gaer: unknown; available: ball, bear, cooks-membrane, fibre-beam, gear",
        ),
        ("gear", {"h": 0.0}, "geometry gear: h must be above 0, not 0.0"),
        ("gear", {"h": float("nan")}, "geometry gear: h must be above 0, not nan"),
        (
            "gear",
            {"cogs": 3},
            "geometry gear: has no cogs; it has h, teeth, root, tip, bore, thick",
        ),
        ("gear", {"tip": -1.0}, "geometry gear: tip must be above 0, not -1.0"),
        ("gear", {"tip": 0.5}, "geometry gear: bore, root, tip = 0.3, 0.8, 0.5: each must exceed"),
        ("gear", {"h": 1e-4}, r"geometry gear: h = 0.0001: would make about 4e.12 cells"),
        ("gear", {"scale": -1.0}, "geometry gear: scale must be above 0, not -1.0"),
    ],
)
def test_geometries_that_are_refused(name, given, message):
    """One line, on all ranks."""
    with pytest.raises(MeshError, match=message) as error:
        geometry(COMM, name, **given)
    assert "\n" not in str(error.value)


def test_without_gmsh_one_line_says_so(monkeypatch):
    found = builtins.__import__

    def missing(name, *arguments, **keywords):
        if name == "gmsh":
            raise ModuleNotFoundError("No module named 'gmsh'", name="gmsh")
        return found(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", missing)
    message = "geometry gear: needs gmsh, which is not installed .pip install gmsh."
    with pytest.raises(MeshError, match=message):
        geometry(COMM, "gear")


@pytest.mark.serial
def test_ball(bodies):
    fine = geometry(COMM, "ball", 0.06)
    converges(np.pi / 6 * (1 - 0.8**3), bodies["ball"], fine)
    assert area(fine, "inner") == pytest.approx(np.pi / 2 * 0.8**2, rel=1e-2)
    assert area(fine, "outer") == pytest.approx(np.pi / 2, rel=1e-2)
    with pytest.raises(MeshError, match=r"geometry ball: inner = 1.5: must be below radius = 1"):
        geometry(COMM, "ball", inner=1.5)


@pytest.mark.serial
def test_rods(bodies):
    """Exactly: three rods, of which the middle counts once."""
    body = bodies["rods"]
    assert volume(body) == pytest.approx(3 * 2 * 0.2**2 - 2 * 0.2**3, rel=1e-12)
    assert area(body, "ends") == pytest.approx(6 * 0.2**2, rel=1e-12)
