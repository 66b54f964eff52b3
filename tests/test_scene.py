"""Scene files and the command line: what they mean, and each way to get them wrong."""

from __future__ import annotations

import re
from pathlib import Path

from mpi4py import MPI

import pytest

from demos.cli import main
from demos.scene import Overrides, Scene, built_in, load, parse
from demos.simulation import build_body
from demos.tables import SceneError
from forms import FORMULATIONS, MATERIALS
from solvers import PRECONDITIONERS, SOLVERS

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
    assert (scene.name, scene.scheme, scene.kernels) == ("square", "backward-euler", "auto")
    assert (scene.mesh.file, scene.mesh.size, scene.mesh.cells) == (None, (1.0, 0.5), (2, 1))
    (material,) = scene.materials
    assert (material.E, material.nu, material.rho, material.tag) == (1e5, 0.3, 1000.0, None)
    (boundary,) = scene.boundaries
    assert (boundary.where.extents, boundary.motion) == ((("x", "min"),), "fixed")
    assert (scene.gravity, scene.h, scene.steps) == ((0.0, -9.81), 0.1, 2)
    assert (scene.formulation, scene.solver, scene.baseline) == ("symmetric", "direct", None)


def test_defaults():
    """No boundary, no load, no [solve]: a free body without weight, the default formulation."""
    text = re.sub(r"\[\[boundary\]\].*\[time\]", "[time]", SQUARE, flags=re.S)
    text = re.sub(r"scheme.*", "", text, flags=re.S)
    scene = parsed(text)
    assert (scene.boundaries, scene.gravity, scene.scheme) == ((), (), "backward-euler")
    assert (scene.formulation, scene.solver, scene.baseline) == ("symmetric", "condensed", None)


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
    assert scene.materials[0].name == "as-rigid-as-possible"


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
    ("[0.0, -9.81]", "[0.0, 0.0, -9.81]", "must have 2 entries, as the box has dimensions"),
    # names
    ('"corotational"', '"corotated"', 'name = "corotated": unknown (did you mean corotational?)'),
    ('"symmetric"', '"mixed"', '[solve] formulation = "mixed": unknown; available: symmetric'),
    ('"backward-euler"', '"rk4"', '[time] scheme = "rk4": unknown; available: backward-euler'),
    ('"fixed"', '"free"', '[[boundary]] motion = "free": unknown'),
    ('"direct"', '"direkt"', '[solve] solver = "direkt": unknown (did you mean direct?)'),
    # planned, not built: refused by name
    *(
        ('"fixed"', f'"{m}"\nrate = 1.0', f'motion = "{m}": not available yet; available: fixed')
        for m in ("stretch", "twist", "bend", "translate")
    ),
    ('"backward-euler"', '"bdf2"', 'scheme = "bdf2": not available yet; available: backward-e'),
    ('"backward-euler"', '"static"', 'scheme = "static": not available yet; available: backward'),
    ("[mesh]\nbox", '[mesh]\ngeometry = "beam"\nbox', "named geometries are not available yet"),
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
    assert [(m.tag, m.E) for m in scene.materials] == [(4, 1e5), (7, 2e5)]
    build_body(scene, COMM)
    one = text.replace("[[boundary]]", "tag = 4\n[[boundary]]")
    other = text.replace("[[boundary]]", second.format(8) + "[[boundary]]")
    for bad, tags in ((one, "[4]"), (other, "[4, 8]")):
        message = f"the cells of the mesh are tagged [4, 7], the materials {tags}"
        with pytest.raises(SceneError, match=re.escape(message)):
            build_body(parse(bad, tmp_path / "two.toml"), COMM)


def test_gravity_must_fit_the_mesh_of_a_file(tmp_path):
    path = tmp_path / "one.mesh"
    if COMM.rank == 0:
        path.write_text(
            "MeshVersionFormatted 2\nDimension 2\nVertices\n3\n0 0 0\n1 0 0\n1 1 0\n"
            "Triangles\n1\n1 2 3 0\nEnd\n"
        )
    COMM.barrier()
    text = re.sub(r"box.*", 'file = "one.mesh"', SQUARE).replace("-9.81]", "-9.81, 0]")
    with pytest.raises(SceneError, match=r"gravity = .*: must have 2 entries, as the mesh has dim"):
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
    (material,) = scene.materials
    assert (material.E, material.nu, material.rho, scene.h) == (1e7, 0.45, 1000.0, 0.1)
    assert scene.baseline == "displacement"


# The command line


def said(capfd) -> str:
    """Standard error of rank 0; every other rank must be silent."""
    captured = capfd.readouterr()
    if COMM.rank != 0:
        assert captured.err == ""
    return COMM.bcast(captured.err)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "the following arguments are required: COMMAND (see mixed-fem --help)"),
        (["runn"], "invalid choice: 'runn'"),
        (["run"], "the following arguments are required: SCENE (see mixed-fem run --help)"),
        (["run", "hanging-bra"], "hanging-bra: neither a built-in scene nor a file (did you mean "),
        (["run", "nothing.toml"], "nothing.toml: neither a built-in scene nor a file; built-in"),
        (["run", "."], ".: cannot be read"),
        (["run", "hanging-bar", "--steps", "many"], "--steps: must be a whole number, not 'many'"),
        (["run", "hanging-bar", "--steps", "0"], "--steps 0: must be a whole number of 1 or more"),
        (["run", "hanging-bar", "--solver", "fieldspilt"], "(did you mean fieldsplit?)"),
        (["run", "hanging-bar", "--resume", "x.h5"], "--resume is not available yet"),
        (["run", "hanging-bar", "--out", "/dev/null/x"], "--out /dev/null/x: cannot be written to"),
        (["run", "hanging-bar", "--fast"], "unrecognized arguments: --fast"),
        (
            ["study", "rate", "--quick"],
            "study rate: unknown; available: benchmark, cost, equi",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_gets_one_line_and_exit_code_2(argv, message, capfd):
    assert main(argv) == 2
    err = said(capfd)
    assert err.startswith("mixed-fem: ")
    assert message in err
    assert err.count("\n") == 1


def test_list_shows_every_name_there_is(capfd):
    assert main(["list"]) == 0
    out = COMM.bcast(capfd.readouterr().out)
    for name in (
        *FORMULATIONS,
        *MATERIALS,
        *SOLVERS,
        *PRECONDITIONERS,
        *built_in(),
        "backward-euler",
        "fixed",
    ):
        assert re.search(rf"^  {re.escape(name)}\s+\S+", out, flags=re.M), name


@pytest.mark.parametrize("argv", [["--help"], ["run", "--help"]])
def test_help(argv, capfd):
    with pytest.raises(SystemExit) as left:
        main(argv)
    assert left.value.code == 0
    captured = capfd.readouterr()
    assert captured.err == ""
    assert ("usage: mixed-fem" in captured.out) == (COMM.rank == 0)
