"""What a user registers works in a scene by its name; `tests/outside.py` has one of each.

Beside them the motions, loads and schemes of the house, and the ways to get their keys wrong.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
import pytest
import ufl
from dolfinx import fem

from demos.app.cli import main
from demos.app.scene import parse
from demos.app.simulation import Simulation, build_body
from demos.app.tables import SceneError
from meshes import box
from meshes.raw import collect
from tests.bodies import largest
from tests.outside import registered  # noqa: F401

COMM = MPI.COMM_WORLD


OUTSIDE = """\
[mesh]
file = "bar.mesh"
[[material]]
name = "kelvin"
E = 10.0
nu = 0.3
rho = 2.0
eta = {eta}
[[boundary]]
where = {{ x = "min" }}
motion = "shake"
amplitude = 0.2
[[load]]
kind = "bed"
k = {k}
where = {{ tag = 7 }}
[time]
h = 0.05
steps = 15
scheme = "{scheme}"
[solve]
formulation = "{formulation}"
"""


def tagged_bar(folder: Path) -> None:
    """The mesh file of a bar of 2 m × 1 m whose lower edges are tagged 7."""
    bar = collect(box(COMM, (2.0, 1.0), (4, 2)))
    if bar is not None:
        lower = np.flatnonzero(bar.points[:, 1] == 0.0)
        lower = lower[np.argsort(bar.points[lower, 0])]
        edges = np.stack([lower[:-1], lower[1:]], axis=1)
        cells = [("triangle", bar.cells), ("line", edges)]
        tags = [np.zeros(len(bar.cells), dtype=int), np.full(len(edges), 7)]
        meshio.Mesh(bar.points, cells, cell_data={"medit:ref": tags}).write(folder / "bar.mesh")
    COMM.barrier()


def final(scene) -> tuple[Simulation, np.ndarray]:
    """A scene after its last step, and the displacement."""
    simulation = Simulation(scene, build_body(scene, COMM))
    for _ in simulation.march(scene.steps):
        pass
    return simulation, simulation.fields[0].x.array


def outside(folder, formulation="compliant", scheme="mean-acceleration", eta=0.4, k=3.0):
    text = OUTSIDE.format(formulation=formulation, scheme=scheme, eta=eta, k=k)
    return final(parse(text, folder / "outside.toml"))[1]


@pytest.mark.usefixtures("registered")
def test_all_from_outside_in_one_scene(tmp_path):
    """The same positions with the displacement method; scheme, bed and memory each tell."""
    tagged_bar(tmp_path)
    u = outside(tmp_path)
    assert largest(u) > 0.1
    plain = outside(tmp_path, "displacement")
    assert largest(u - plain) < 1e-7
    for change in ({"scheme": "backward-euler"}, {"k": 0.0}, {"eta": 0.0}):
        assert largest(outside(tmp_path, "displacement", **change) - plain) > 1e-3


@pytest.mark.usefixtures("registered")
def test_the_command_line_lists_and_runs_what_is_registered(tmp_path, capsys):
    tagged_bar(tmp_path)
    path = tmp_path / "outside.toml"
    if COMM.rank == 0:
        text = OUTSIDE.format(formulation="compliant", scheme="mean-acceleration", eta=0.4, k=3.0)
        path.write_text(text.replace("steps = 15", "steps = 1"), encoding="utf-8")
    COMM.barrier()
    assert main(["list"]) == 0
    listed = COMM.bcast(capsys.readouterr().out)
    for name in ("mean-acceleration", "bed", "shake", "kelvin", "compliant"):
        assert f"\n  {name} " in listed
    assert "To and fro along y. Keys: where, [components], amplitude, [frequency]" in listed
    assert "body-force" not in listed  # it is a function
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0


INSIDE = """\
[mesh]
box = { size = [2.0, 1.0], cells = [4, 2] }
[[material]]
name = "stable-neo-hookean"
E = 10.0
nu = 0.3
rho = 2.0
[[boundary]]
where = { x = "min" }
motion = "fixed"
components = "x"
[[boundary]]
where = { y = "min" }
motion = "fixed"
components = ["y"]
[[boundary]]
where = { x = "max" }
motion = "stretch"
rate = 0.1
components = "x"
[[load]]
kind = "traction"
where = { y = "max" }
value = [0.0, 1.0]
[time]
h = 1
steps = 2
scheme = "static"
[solve]
solver = "condensed"
"""


def inside(*changes: tuple[str, str]):
    """The scene, changed; each old text stands there once."""
    text = INSIDE
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    return parse(text, Path("inside.toml"))


def test_a_static_stretch_under_a_traction():
    """A homogeneous state: the strain prescribed, and across it the stress that is asked for."""
    simulation, u = final(inside())
    X = simulation.model.u.function_space.tabulate_dof_coordinates()
    np.testing.assert_allclose(u.reshape(-1, 2)[:, 0], 0.2 * X[:, 0], rtol=0, atol=1e-9)
    stress = simulation.cell_means().stress
    np.testing.assert_allclose(stress[:, 1, 1], 1.0, rtol=0, atol=1e-8)
    assert simulation.energies().kinetic == 0.0


def test_a_pressure_against_the_material_in_closed_form():
    """On a face that stays flat p acts by area now: P₂₂ = -p λ₁, where λ₁ is prescribed."""
    value = ('kind = "traction"', 'kind = "pressure"'), ("value = [0.0, 1.0]", "value = 1.5")
    for solver in ("condensed", "direct", "fieldsplit"):
        simulation, _ = final(inside(*value, ('solver = "condensed"', f'solver = "{solver}"')))
        means = simulation.cell_means()
        stretch, stress = means.stretch, means.stress
        np.testing.assert_allclose(stress[:, 1, 1], -1.5 * 1.2, rtol=0, atol=1e-8)
        assert (stretch[:, 1, 1] < 0.95).all()
    # ∂Ψ/∂λ₂ of the stable neo-Hookean material, μ = E/(2(1 + ν)), λ = E ν/((1 + ν)(1 - 2ν)).
    mu, lam = 10.0 / 2.6, 3.0 / (1.3 * 0.4)
    across = stretch[:, 1, 1]
    P22 = -mu * 1.2 + lam * (1.2 * across - 1) * 1.2 + mu * across
    np.testing.assert_allclose(P22, -1.5 * 1.2, rtol=0, atol=1e-8)


@pytest.mark.parametrize("scheme", ["backward-euler", "implicit-midpoint", "bdf2"])
@pytest.mark.parametrize("load", ["", "[load]\ngravity = [0.0, 0.0]\n"])
def test_a_scene_without_weight_stays_at_rest(scheme, load):
    text = INSIDE.replace('"static"', f'"{scheme}"').replace('"stretch"\nrate = 0.1', '"fixed"')
    start, end = text.index("[[load]]"), text.index("[time]")
    simulation, u = final(parse(text[:start] + load + text[end:], Path("rest.toml")))
    assert largest(u) < 1e-12
    np.testing.assert_allclose(simulation.energies(), 0.0, atol=1e-12)


def test_gravity_among_several_loads():
    """As an entry of [[load]] it is what it is as [load], and points downwards in the picture."""
    gravity = ('kind = "traction"\nwhere = { y = "max" }\nvalue', 'kind = "gravity"\ng')
    _, u = final(
        scene := inside(gravity, ("[time]", '[[load]]\nkind = "gravity"\ng = [0, 2]\n[time]'))
    )
    assert scene.gravity == (0.0, 3.0)
    start, end = INSIDE.index("[[load]]"), INSIDE.index("[time]")
    table = f"{INSIDE[:start]}[load]\ngravity = [0.0, 3.0]\n{INSIDE[end:]}"
    _, other = final(parse(table, Path("table.toml")))
    assert largest(u) > 0.1
    assert largest(u - other) < 1e-12


def test_a_motion_by_a_table_that_halts():
    """There and half the way back, then no further: the same strain by either spelling."""
    for amount in (
        "table = [[0.0, 0.0], [1.5, 0.3], [2.0, 0.2], [2.5, 0.2]]",
        "rate = 0.2\nend = 1.0",
    ):
        simulation, u = final(inside(("rate = 0.1", amount), ("steps = 2", "steps = 3")))
        X = simulation.model.u.function_space.tabulate_dof_coordinates()
        np.testing.assert_allclose(u.reshape(-1, 2)[:, 0], 0.2 * X[:, 0], rtol=0, atol=1e-9)


RESTING = """\
[[contact]]
plane = [0.0, 2.0]
offset = -0.25
stiffness = 1e3
[[load]]
kind = "gravity"
g = [0.0, -0.5]
[[load]]
kind = "point-force"
where = { x = "max", y = "max" }
force = [0.0, -0.5]
[time]
"""


def test_a_block_comes_to_rest_on_a_floor():
    """Which then carries its weight and what is put on it: k ∫ depth dA = 2 N + ½ N."""
    text = INSIDE.replace('"static"', '"backward-euler"').replace("steps = 2", "steps = 40")
    text = text.replace('where = { y = "min" }\nmotion = "fixed"\ncomponents = ["y"]', "")
    start, end = text.index('[[boundary]]\nwhere = { x = "min"'), text.index("[time]\n")
    held = '[[boundary]]\nwhere = { x = "min" }\nmotion = "fixed"\ncomponents = "x"\n'
    text = text[:start] + held + RESTING + text[end + len("[time]\n") :]
    simulation, _ = final(parse(text, Path("resting.toml")))
    msh, u = simulation.body.mesh, simulation.model.u
    depth = -0.25 - ufl.SpatialCoordinate(msh)[1] - u[1]
    carried = ufl.conditional(ufl.gt(depth, 0.0), 1e3 * depth, 0.0) * ufl.ds
    force = COMM.allreduce(fem.assemble_scalar(fem.form(carried)))
    assert force == pytest.approx(2.5, rel=1e-3)
    assert simulation.energies().kinetic < 1e-6


STRETCH = 'motion = "stretch"'
WRONG = [
    ("rate = 0.1", "", "[[boundary]] 3: needs either a rate or a table"),
    ("rate = 0.1", "rat = 0.1", "[[boundary]] 3: unknown key rat (did you mean rate?)"),
    (
        "rate = 0.1",
        "rate = 1\nspeed = 1",
        "[[boundary]] 3: unknown key speed; known: motion, where",
    ),
    ("rate = 0.1", 'rate = "0.1 * t"', '[[boundary]] 3 rate = "0.1 * t": must be a finite number'),
    ("rate = 0.1", "rate = true", "[[boundary]] 3 rate = True: must be a finite number"),
    ("rate = 0.1", "rate = inf", "[[boundary]] 3 rate = inf: must be a finite number"),
    (
        "rate = 0.1",
        'rate = 1\naxis = "w"',
        '[[boundary]] 3: axis is "w"; in 2D it must be one of x',
    ),
    ("rate = 0.1", "rate = 1\naxis = 1", "[[boundary]] 3 axis = 1: must be text in quotes"),
    ('["y"]', '"z"', '[[boundary]] 2: axis is "z"; in 2D it must be one of x, y'),
    ('["y"]', "[1]", "[[boundary]] 2 components = [1]: must be text in quotes or a list of texts"),
    (
        f"{STRETCH}\nrate = 0.1",
        'motion = "translate"\nrate = [1.0]',
        "[[boundary]] 3: Translate: ra",
    ),
    (
        STRETCH,
        'motion = "strech"',
        '[[boundary]] 3 motion = "strech": unknown (did you mean stretch',
    ),
    ('{ x = "max" }', "{ x = [3.0, 4.0] }", "[[boundary]] 3: { x = [3, 4] } holds no vert"),
    ("value = [0.0, 1.0]", "", "[[load]]: misses the key value"),
    ("value = [0.0, 1.0]", "value = 1.0", "[[load]] value = 1.0: must be a list of finite numbers"),
    ("value = [0.0, 1.0]", "value = [1.0]", "[[load]]: Traction: value must be 2 numbers"),
    (
        "value = [0.0, 1.0]",
        "value = [1, 2]\nat = 1",
        "[[load]]: unknown key at; known: kind, table, value",
    ),
    ('{ y = "max" }', '{ tag = "top" }', '[[load]]: { tag = "top" }: the mesh has no such tag'),
    ('{ y = "max" }', '"top"', "[[load]]: where: must be a table such as"),
    (
        '"traction"',
        '"body-force"',
        'kind = "body-force": unknown (did you mean point-force?); available: gravity',
    ),
    ("[[load]]", "[load]", "[load]: unknown key kind; known: gravity"),
    ('"static"', '"statics"', '[time] scheme = "statics": unknown (did you mean static?); availab'),
    ("rho = 2.0", "rho = 2.0\nb = 1", "[[material]]: unknown key b; known: name, E, nu, rho"),
    ('"stable-neo-hookean"', '"fung"\nb = "1"', '[[material]] b = "1": must be a finite number'),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[w[2][:60] for w in WRONG])
def test_what_is_wrong_is_named(old, new, message):
    """By file, place and key, in one line."""
    with pytest.raises(SceneError) as error:
        build_body(inside((old, new)), COMM)
    assert str(error.value).startswith("inside.toml: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("registered")
def test_a_class_from_outside_checks_its_own_range(tmp_path):
    text = OUTSIDE.format(formulation="compliant", scheme="mean-acceleration", eta=0.4, k=-1.0)
    message = r"\[\[load\]\]: k is -1.0; the stiffness of a bed \[Pa/m\] must not be negative"
    with pytest.raises(SceneError, match=message):
        parse(text, tmp_path / "outside.toml")
