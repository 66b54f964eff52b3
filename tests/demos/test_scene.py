"""Scene files: what they mean, and each way to get them wrong."""

from __future__ import annotations

import re
from pathlib import Path

from mpi4py import MPI

import pytest

from demos.app.scene import Overrides, Scene, built_in, load, parse
from demos.app.simulation import build_body
from demos.app.tables import SceneError
from forms import Corotational, Fixed
from meshes import Where

COMM = MPI.COMM_WORLD

SQUARE = """\
[mesh]
box = { size = [1.0, 0.5], cells = [2, 1] }
[[material]]
name = "corotational"
E = 1e5
nu = 0.3
rho = 1000
[[boundary]]
where = { x = "min" }
motion = "fixed"
[load]
gravity = [0.0, -9.81]
[time]
h = 0.1
steps = 2
scheme = "backward-euler"
[solve]
formulation = "symmetric"
solver = "direct"
"""


def parsed(text: str, **overrides) -> Scene:
    return parse(text, Path("square.toml"), Overrides(**overrides))


def test_a_scene_means_what_it_says():
    scene = parsed(SQUARE)
    assert (scene.name, scene.scheme) == ("square", "backward-euler")
    assert (scene.mesh.file, scene.mesh.size, scene.mesh.cells) == (None, (1.0, 0.5), (2, 1))
    (region,) = scene.regions
    assert (region.material, region.rho, region.tag) == (Corotational(1e5, 0.3), 1000.0, None)
    (boundary,) = scene.boundaries
    assert boundary.motion == Fixed(Where(extents=(("x", "min"),)))
    assert (scene.gravity, scene.h, scene.steps) == ((0.0, -9.81), 0.1, 2)
    assert (scene.formulation, scene.solver, scene.baselines) == ("symmetric", "direct", ())


def test_defaults():
    """No boundary, no load, no [solve]: a free body without weight, the default formulation."""
    text = re.sub(r"\[\[boundary\]\].*\[time\]", "[time]", SQUARE, flags=re.S)
    text = re.sub(r"scheme.*", "", text, flags=re.S)
    scene = parsed(text)
    assert (scene.boundaries, scene.gravity, scene.scheme) == ((), (), "backward-euler")
    assert (scene.formulation, scene.solver, scene.baselines) == ("symmetric", "condensed", ())


def test_elements():
    """Triangles and degree 1 unless a scene says otherwise."""
    scene = parsed(SQUARE)
    assert (build_body(scene, COMM).num_cells, scene.degree) == (4, 1)
    text = SQUARE.replace("cells = [2, 1]", 'cells = [2, 1], cell = "quadrilateral"')
    scene = parsed(text + "degree = 2\n")
    assert (build_body(scene, COMM).num_cells, scene.degree) == (2, 2)


def test_the_mesh_file_is_relative_to_the_scene_file():
    text = re.sub(r"box.*", 'file = "../meshes/bar.msh"', SQUARE)
    scene = parse(text, Path("/scenes/mine/bar.toml"))
    assert scene.mesh.file == Path("/scenes/mine/../meshes/bar.msh")


def test_overrides_win_and_may_repair_what_is_not_available():
    text = SQUARE.replace('"direct"', '"condensed"')
    scene = parsed(
        text, steps=7, formulation="seed", material="as-rigid-as-possible", solver="direct"
    )
    assert (scene.steps, scene.formulation, scene.solver) == (7, "seed", "direct")
    assert scene.regions[0].name == "as-rigid-as-possible"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ({"steps": 0}, "--steps 0: must be a whole number of 1 or more"),
        ({"formulation": "sead"}, '--formulation "sead": unknown (did you mean seed?); available'),
        ({"material": "jelly"}, '--material "jelly": unknown; available: as-rigid'),
        ({"solver": "splitfield"}, '--solver "splitfield": unknown'),
    ],
)
def test_overrides_are_checked(override, message):
    with pytest.raises(SceneError, match=re.escape(message)):
        parsed(SQUARE, **override)


BOX = "box = { size = [1.0, 0.5], cells = [2, 1] }"
WRONG = [
    # unknown and missing keys
    ("E = 1e5", "e = 1e5", "[[material]]: misses the key E (is e meant?)"),
    ("nu = 0.3", "poisson = 0.3", "[[material]]: misses the key nu"),
    (
        "rho = 1000",
        "rho = 1000\ncolour = 1",
        "[[material]]: unknown key colour; known: name, E",
    ),
    ("steps = 2", "steps = 2\nstep = 3", "[time]: unknown key step (did you mean steps?)"),
    ("[load]", "[laod]", "unknown key laod (did you mean load?); known: description, mesh"),
    ("[[material]]", "[[materials]]", "misses the key material (is materials meant?)"),
    ('motion = "fixed"', "", "[[boundary]]: misses the key motion"),
    ('where = { x = "min" }', "", "[[boundary]]: misses the key where"),
    ("[time]\nh = 0.1\nsteps = 2", "[tiem]", "misses the key time (is tiem meant?)"),
    ("h = 0.1", "", "[time]: misses the key h"),
    # wrong types
    ("[[material]]", "[material]", "material must be written as [[material]], once for each"),
    ("h = 0.1", 'h = "0.1"', '[time] h = "0.1": must be a time step in seconds, above 0'),
    ("steps = 2", "steps = 2.0", "[time] steps = 2.0: must be a whole number of 1 or more"),
    ("steps = 2", "steps = true", "[time] steps = True: must be a whole number of 1 or more"),
    ("nu = 0.3", "nu = [0.3]", "[[material]] nu = [0.3]: must be a finite number"),
    ("nu = 0.3", "nu = nan", "[[material]] nu = nan: must be a finite number"),
    ("E = 1e5", "E = inf", "[[material]] E = inf: must be a Young's modulus in Pa, above 0"),
    ("E = 1e5", f"E = 1{'0' * 400}", "must be a Young's modulus in Pa, above 0"),
    ("-9.81]", '"down"]', "gravity = [0.0, 'down']: must hold finite numbers only"),
    ("[0.0, -9.81]", "-9.81", "[load] gravity = -9.81: must be a list of 2 or 3 numbers"),
    ('"corotational"', "1", "[[material]] name = 1: must be a name in quotes; available: as-"),
    ('"symmetric"', '["seed"]', "[solve] formulation = ['seed']: must be a name in quotes"),
    ("box = { size", "box = 1 #", "[mesh] box = 1: must be a table"),
    # wrong ranges
    ("nu = 0.3", "nu = 0.5", "[[material]] nu = 0.5: must lie between -1 and 0.5, both excluded"),
    ("nu = 0.3", "nu = -1", "[[material]] nu = -1: must lie between -1 and 0.5, both excluded"),
    ("E = 1e5", "E = 0", "[[material]] E = 0: must be a Young's modulus in Pa, above 0"),
    ("rho = 1000", "rho = -1", "[[material]] rho = -1: must be a density in kg/m³, above 0"),
    ("h = 0.1", "h = 0", "[time] h = 0: must be a time step in seconds, above 0"),
    ("steps = 2", "steps = 0", "[time] steps = 0: must be a whole number of 1 or more"),
    ("[1.0, 0.5]", "[1.0, -0.5]", "[mesh] box size = [1.0, -0.5]: must be 2 or 3 positive"),
    ("[2, 1]", "[2, 0]", "[mesh] box cells = [2, 0]: must be 2 whole numbers of 1 or more"),
    ("[2, 1]", "[2, 1, 1]", "[mesh] box cells = [2, 1, 1]: must be 2 whole numbers"),
    ("[2, 1]", "[2, 1.5]", "[mesh] box cells = [2, 1.5]: must be 2 whole numbers"),
    (
        "[2, 1]",
        '[2, 1], cell = "hexahedron"',
        '[mesh] box cell = "hexahedron": unknown; available: triangle, quadrilateral',
    ),
    ('"direct"', '"direct"\ndegree = 0', "[solve] degree = 0: must be a whole number of 1 or more"),
    # names
    ('"corotational"', '"corotated"', 'name = "corotated": unknown (did you mean corotational?)'),
    ('"symmetric"', '"mixed"', '[solve] formulation = "mixed": unknown; available: symmetric'),
    ('"backward-euler"', '"rk4"', '[time] scheme = "rk4": unknown; available: backward-euler'),
    ('"fixed"', '"free"', '[[boundary]] motion = "free": unknown'),
    (
        '"direct"',
        '"direct"\nbaseline = 3',
        "[solve] baseline = 3: must be a formulation in quotes, or a list of such; a globalisation",
    ),
    (
        '"direct"',
        '"direct"\nbaseline = ["displacement", "displacment full-steps"]',
        "unknown formulation displacment (did you mean displacement?); available: symmetric",
    ),
    (
        '"direct"',
        '"direct"\nbaseline = "displacement half-steps"',
        "unknown globalisation half-steps (did you mean full-steps?); available: watchdog",
    ),
    (
        '"direct"',
        '"direct"\nglobalisation = "watch-dog"',
        '[solve] globalisation = "watch-dog": unknown (did you mean watchdog?)',
    ),
    ('"direct"', '"direkt"', '[solve] solver = "direkt": unknown (did you mean direct?)'),
    (
        "[[boundary]]",
        '[[material]]\nname = "corotational"\nE = 1\nnu = 0\nrho = 1\ntag = 2\n[[boundary]]',
        "[[material]] 1: misses the key tag",
    ),
    (
        "[[boundary]]",
        'tag = 1\n[[material]]\nname = "corotational"\nE = 1\nnu = 0\nrho = 1\ntag = 1\n'
        "[[boundary]]",
        "[[material]] 2 tag = 1: names cells that already have a material",
    ),
    # the mesh and vertex sets
    ("[mesh]\nbox", '[mesh]\nfile = "a.msh"\nbox', "[mesh]: needs either file = "),
    ("[mesh]\nbox", '[mesh]\ngeometry = "gear"\nbox', "[mesh]: needs either file = "),
    (f"[mesh]\n{BOX}", '[mesh]\ngeometry = "gaer"', 'geometry = "gaer": unknown (did you mean gea'),
    (f"[mesh]\n{BOX}", '[mesh]\ngeometry = "gear"\nh = 0', "[mesh] h = 0: must be a size of elem"),
    (BOX, f"{BOX}\nh = 0.1", "[mesh]: unknown key h; known: refine, scale, box"),
    (BOX, f"{BOX}\nrefine = -1", "[mesh] refine = -1: must be a whole number of 0 or more"),
    (BOX, f"{BOX}\nrefine = 1.0", "[mesh] refine = 1.0: must be a whole number of 0 or more"),
    (BOX, f"{BOX}\nscale = 0.0", "[mesh] scale = 0.0: must be metres in a unit of the mesh, abo"),
    (BOX, f'{BOX}\nscale = "mm"', '[mesh] scale = "mm": must be metres in a unit of the mesh'),
    ("rho = 1000", "rho = 1000\ntag = 1.5", "[[material]] tag = 1.5: must be a whole number or a"),
    ("box = { size = [1.0, 0.5], cells = [2, 1] }", "", "[mesh]: needs either file = "),
    ('{ x = "min" }', '{ x = "left" }', '[[boundary]]: where: x must be "min", "max" or'),
    ('{ x = "min" }', "{ r = 1 }", "[[boundary]]: where: unknown key r; known: x, y, z"),
    ('{ x = "min" }', '"x"', "[[boundary]]: where: must be a table such as"),
    # nothing is code
    ("E = 1e5", 'E = "1e5 * 2"', '[[material]] E = "1e5 * 2": must be a Young\'s modulus'),
    # not TOML
    ("[time]", "[time", "not valid TOML"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[w[2][:60] for w in WRONG])
def test_what_is_wrong_is_named(old, new, message):
    """The message names file, key, what is wrong and what would be right, in one line."""
    assert SQUARE.count(old) == 1
    with pytest.raises(SceneError, match=re.escape(message)) as error:
        parsed(SQUARE.replace(old, new))
    assert str(error.value).startswith("square.toml: ")
    assert "\n" not in str(error.value)


def test_two_materials_by_cell_tag(tmp_path):
    """Each cell tag of the mesh needs a material, and each material cells."""
    path = tmp_path / "two.mesh"
    if COMM.rank == 0:
        path.write_text(
            "MeshVersionFormatted 2\nDimension 2\nVertices\n4\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
            "Triangles\n2\n1 2 3 4\n1 3 4 7\nEnd\n"
        )
    COMM.barrier()
    second = 'tag = 4\n[[material]]\nname = "corotational"\nE = 2e5\nnu = 0\nrho = 1\ntag = {}\n'
    text = re.sub(r"box.*", 'file = "two.mesh"', SQUARE)
    good = text.replace("[[boundary]]", second.format(7) + "[[boundary]]")
    scene = parse(good, tmp_path / "two.toml")
    assert [(r.tag, r.material.E) for r in scene.regions] == [(4, 1e5), (7, 2e5)]
    build_body(scene, COMM)
    one = text.replace("[[boundary]]", "tag = 4\n[[boundary]]")
    other = text.replace("[[boundary]]", second.format(8) + "[[boundary]]")
    for bad, tags in ((one, "[4]"), (other, "[4, 8]")):
        message = f"the cells of the mesh are tagged [4, 7], the materials {tags}"
        with pytest.raises(SceneError, match=re.escape(message)):
            build_body(parse(bad, tmp_path / "two.toml"), COMM)


def test_gravity_must_fit_the_mesh(tmp_path):
    path = tmp_path / "one.mesh"
    if COMM.rank == 0:
        path.write_text(
            "MeshVersionFormatted 2\nDimension 2\nVertices\n3\n0 0 0\n1 0 0\n1 1 0\n"
            "Triangles\n1\n1 2 3 0\nEnd\n"
        )
    COMM.barrier()
    text = re.sub(r"box.*", 'file = "one.mesh"', SQUARE).replace("-9.81]", "-9.81, 0]")
    with pytest.raises(SceneError, match=r"\[load\] gravity: .*: g must be 2 numbers, as the body"):
        build_body(parse(text, tmp_path / "one.toml"), COMM)


def test_an_unreadable_mesh_names_scene_and_file(tmp_path):
    text = re.sub(r"box.*", 'file = "absent.mesh"', SQUARE)
    with pytest.raises(SceneError, match=r"one.toml: \[mesh\]: .*absent.mesh: no such file"):
        build_body(parse(text, tmp_path / "one.toml"), COMM)


@pytest.mark.parametrize("name", built_in())
def test_built_in_scenes_are_valid_and_described(name):
    scene = load(COMM, name)
    assert scene.name == name
    assert scene.description
    assert build_body(scene, MPI.COMM_SELF).num_cells > 0


def test_hanging_bar_is_the_documented_one():
    scene = load(COMM, "hanging-bar")
    assert build_body(scene, MPI.COMM_SELF).num_cells == 648
    (region,) = scene.regions
    assert (region.material.E, region.material.nu) == (1e7, 0.45)
    assert (region.rho, scene.h) == (1000.0, 0.1)
    assert list(map(str, scene.baselines)) == ["displacement"]
