"""What a scene says of its mesh: units, refinement, regions by name; parts held by nothing."""

from __future__ import annotations

import numpy as np
import pytest

from demos.app.cli import main
from demos.app.output import final_state
from demos.app.scene import parse
from demos.app.simulation import Simulation, build_body
from demos.app.tables import SceneError
from meshes import box
from meshes.raw import collect
from tests.mesh_files import COMM, put_text, rows, write

SCENE = """
[mesh]
{mesh}

{materials}
[[boundary]]
where = {where}
motion = "fixed"

[load]
gravity = [0.0, -9.81]

[time]
h = 0.05
steps = 1
"""
SOFT = '[[material]]\nname = "corotational"\nE = 1e5\nnu = 0.3\nrho = 1000.0\n'
BAR = "box = { size = [2.0, 1.0], cells = [4, 2] }"


def scene(path, mesh=BAR, materials=SOFT, where='{ x = "min" }'):
    """A scene beside the meshes of the test."""
    return parse(SCENE.format(mesh=mesh, materials=materials, where=where), path / "scene.toml")


def final(given) -> dict:
    """Its final state, on all ranks."""
    simulation = Simulation(given, build_body(given, COMM))
    list(simulation.march(given.steps))
    return COMM.bcast(final_state(simulation))


def millimetres(path, shift: float = 0.0, twice: bool = False):
    """The bar in millimetres; or two of them, one above the other, with the halves as sets."""
    bar = collect(box(COMM, (2000.0, 1000.0), (4, 2)))
    text = ""
    if bar is not None:
        points, cells = bar.points, bar.cells
        if twice:
            points = np.vstack([points, points + np.array([0, shift])])
            cells = np.vstack([cells, cells + len(bar.points)])
        left = points[cells].mean(axis=1)[:, 0] < 1000.0
        text = f"*NODE\n{rows(points, 1, ', ')}*ELEMENT, TYPE=CPE3\n{rows(cells + 1, 1, ', ')}"
        for name, chosen in (("LEFT", left), ("RIGHT", ~left)):
            members = ",\n".join(map(str, np.flatnonzero(chosen) + 1))
            text += f"*ELSET, ELSET={name}\n{members}\n"
    return put_text(path / "bar.inp", COMM.bcast(text))


def test_units(tmp_path):
    """A file in millimetres moves as the box in metres does, and a box of other units, too."""
    millimetres(tmp_path)
    expected = final(scene(tmp_path))
    for mesh in (
        'file = "bar.inp"\nscale = 0.001',
        f"{BAR}\nscale = 1.0",
        "box = { size = [20.0, 10.0], cells = [4, 2] }\nscale = 0.1",
    ):
        found = final(scene(tmp_path, mesh))
        np.testing.assert_allclose(found["x"], expected["x"], rtol=0, atol=1e-12)
    assert np.ptp(expected["x"][:, 1]) > 1.001


def test_refinement(tmp_path):
    """A refined file and a refined box move as the finer box does, whatever the order."""
    millimetres(tmp_path)
    fine = final(scene(tmp_path, BAR.replace("[4, 2]", "[8, 4]")))
    order = np.lexsort(np.round(fine["X"], 9).T)
    for mesh in (f"{BAR}\nrefine = 1", 'file = "bar.inp"\nscale = 0.001\nrefine = 1'):
        found = final(scene(tmp_path, mesh))
        mine = np.lexsort(np.round(found["X"], 9).T)
        np.testing.assert_allclose(found["X"][mine], fine["X"][order], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found["x"][mine], fine["x"][order], rtol=0, atol=1e-10)


def test_regions_by_name(tmp_path):
    """Element sets are materials: a stiffer right half is what stiffer cells there are."""
    millimetres(tmp_path)
    mesh = 'file = "bar.inp"\nscale = 0.001'
    hard = SOFT.replace("1e5", "5e6")
    whole = final(scene(tmp_path, mesh))
    same = final(scene(tmp_path, mesh, f'{SOFT}tag = "LEFT"\n{SOFT}tag = "RIGHT"\n'))
    np.testing.assert_allclose(same["x"], whole["x"], rtol=0, atol=1e-12)
    state = final(scene(tmp_path, mesh, f'{SOFT}tag = "LEFT"\n{hard}tag = "RIGHT"\n'))
    right = state["X"][state["cells"]].mean(axis=1)[:, 0] > 1.0
    strain = np.linalg.norm(state["S"] - np.eye(2), axis=(1, 2))
    assert strain[right].max() < 0.1 * strain[~right].max()
    with pytest.raises(SceneError) as error:
        build_body(scene(tmp_path, mesh, f'{SOFT}tag = "LEFT"\n'), COMM)
    assert str(error.value).endswith(
        "[[material]] tag: the cells of the mesh are tagged [0, 'LEFT', 'RIGHT'], the materials "
        "['LEFT']; each cell needs one material, and cell 4 (from 0) is tagged none of LEFT"
    )


def test_a_run_warns_of_parts_that_nothing_holds(tmp_path, caplog):
    """One line, on rank 0, which names the part; all parts held are told more briefly."""
    millimetres(tmp_path, shift=1000.0, twice=True)
    mesh = 'file = "bar.inp"\nscale = 0.001'
    build_body(scene(tmp_path, mesh, where='{ y = "max" }'), COMM)
    build_body(scene(tmp_path, mesh), COMM)
    build_body(scene(tmp_path), COMM)
    records = COMM.bcast([r.getMessage() for r in caplog.records if r.name == "mixed_fem"])
    assert len(records) == 2
    assert records[0].endswith(
        "scene.toml: the body is in 2 parts that share no vertex, so that each moves by itself; "
        "nothing holds part 1 (16 cells, the first is cell 0; x from 0 to 2, y from 0 to 1)"
    )
    assert "the boundary clauses hold each of them" in records[1]
    if COMM.rank > 0:
        assert not caplog.records


def test_the_whole_way(tmp_path):
    """A tagged file through the command line."""
    path = write(
        tmp_path / "square.mesh",
        [[0, 0], [1, 0], [1, 1], [0, 1]],
        [("triangle", np.array([[0, 1, 2], [0, 2, 3]])), ("line", np.array([[3, 0]]))],
        cell_data={"medit:ref": [np.array([4, 4]), np.array([7])]},
    )
    text = SCENE.format(
        mesh=f'file = "{path.name}"\nrefine = 2', materials=f"{SOFT}tag = 4\n", where="{ tag = 7 }"
    )
    put_text(tmp_path / "square.toml", text)
    assert main(["run", str(tmp_path / "square.toml"), "--out", str(tmp_path / "out")]) == 0
    COMM.barrier()
    with np.load(tmp_path / "out" / "final.npz") as state:
        left = state["X"][:, 0] == 0.0
        assert left.sum() == 5 and len(state["X"]) == 25
        np.testing.assert_array_equal(state["x"][left], state["X"][left])
        assert (state["x"][~left, 1] < state["X"][~left, 1]).all()
