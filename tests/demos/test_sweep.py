"""Sweeps: what is measured, orders and extrapolation, and what is refused."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from demos.app.cli import main
from demos.app.scene import parse
from demos.app.simulation import Simulation, build_body
from demos.app.sweep import axis
from demos.studies.richardson import DOUBTFUL, SAFETY, convergence
from tests.demos.scenes import bar as bar_text

COMM = MPI.COMM_WORLD

BAR = bar_text('scheme = "static"\nh = 0.5\nsteps = 2\n', g=-2.0)


@pytest.fixture
def bar(tmp_path: Path) -> str:
    path = Path(COMM.bcast(str(tmp_path))) / "bar.toml"
    if COMM.rank == 0:
        path.write_text(BAR)
    COMM.barrier()
    return str(path)


def records(out: Path) -> list[dict]:
    COMM.barrier()
    return json.loads(next(out.glob("*.json")).read_text())["records"]


@pytest.mark.parametrize("p", [0.7, 1.0, 2.0, 3.5])
def test_richardson_finds_what_is_there(p):
    """f + c hᵖ, with steps of unlike ratios."""
    sizes = [1.0, 0.5, 0.3, 0.1]
    found = convergence(sizes, [2.0 - 0.3 * h**p for h in sizes])
    assert found.order == pytest.approx(p, rel=1e-9)
    assert found.limit == pytest.approx(2.0, rel=1e-9)
    assert found.index == pytest.approx(SAFETY * 0.3 * 0.1**p, rel=1e-6)
    assert found.remark == ""


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([1.0, 2.0], "needs three levels"),
        ([1.0, 2.0, 1.5], "to and fro"),
        ([1.0, 1.1, 2.0], "does not settle"),
        ([1.0, 1.5, 1.75], "one order only"),
        ([1.0, 1.0, 1.0], "the same on all"),
        ([0.0, 1.0, 1.1, 1.15], "not yet asymptotic: the order of the levels before is 3.32"),
        ([1.2, 1.0, 1.1, 1.15], "not yet asymptotic: the order of the levels before is none"),
    ],
)
def test_richardson_says_what_it_cannot_know(values, told):
    found = convergence([1.0, 0.5, 0.25, 0.125][: len(values)], values)
    assert told in found.remark
    assert math.isnan(found.limit) == (len(values) < 3 or "asymptotic: it" in found.remark)
    if "order" in told:
        assert found.index == pytest.approx(DOUBTFUL * abs(found.limit - values[-1]))


def test_measures(bar, tmp_path):
    """Beside the run itself."""
    names = ["tip.y", "at(1,0.5).x", "von_mises(0.1,0.1)", "strain(0.1,0.1)", "reaction.1.y"]
    names += ["energy.elastic", "energy.missing", "work.loads", "iterations", "iterations.most"]
    names += ["krylov", "seconds"]
    out = Path(COMM.bcast(str(tmp_path))) / "out"
    asked = [word for name in names for word in ("--measure", name)]
    assert main(["sweep", bar, "--vary", "material.E=1e5,2e5", *asked, "--out", str(out)]) == 0
    first, second = records(out)
    assert (first["material.E"], second["material.E"]) == (1e5, 2e5)

    scene = parse(BAR, Path(bar))
    simulation = Simulation(scene, build_body(scene, COMM))
    results = list(simulation.march(scene.steps))
    X = simulation.body.gather_points(everywhere=True)
    x = X + simulation.body.gather(simulation.fields[0], everywhere=True)
    corner = np.argmin(np.linalg.norm(X - [2.0, 1.0], axis=1))
    middle = np.argmin(np.linalg.norm(X - [1.0, 0.5], axis=1))
    assert first["tip.y"] == pytest.approx(x[corner, 1], abs=1e-12)
    assert first["at(1,0.5).x"] == pytest.approx(x[middle, 0], abs=1e-12)
    assert first["reaction.1.y"] == pytest.approx(2.0 * 1000.0 * 2.0, rel=1e-9)
    assert first["energy.elastic"] == pytest.approx(simulation.energies().elastic, rel=1e-9)
    assert first["work.loads"] == pytest.approx(-simulation.energies().potential, rel=1e-9)
    assert first["iterations"] == sum(r.iterations for r in results)
    assert first["iterations.most"] == max(r.iterations for r in results)
    means = simulation.cell_means()
    stretch = simulation.body.gather(means.stretch, everywhere=True)
    stress = simulation.body.gather(means.von_mises, everywhere=True)
    strains = np.linalg.norm(stretch - np.eye(2), axis=(1, 2))
    assert np.abs(strains - first["strain(0.1,0.1)"]).min() < 1e-9
    assert np.abs(stress / first["von_mises(0.1,0.1)"] - 1).min() < 1e-9
    assert second["energy.elastic"] < first["energy.elastic"]


@pytest.mark.serial
def test_finer_meshes_and_steps(bar, tmp_path, capsys):
    """The table has orders and extrapolations; the end of the run stays; cases are kept."""
    command = ["sweep", bar, "--vary", "mesh.refine=0:3", "--vary", "time.h=1.0,0.5"]
    command += ["--measure", "energy.elastic", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    told = capsys.readouterr().out
    found = records(tmp_path / "out")
    assert len(found) == 8
    energies = [r["energy.elastic"] for r in found if r["time.h"] == 1.0]
    again = [r["energy.elastic"] for r in found if r["time.h"] == 0.5]
    assert energies == pytest.approx(again, rel=1e-9)  # in statics of one load
    assert np.all(np.diff(energies) > 0)
    expected = convergence([1, 0.5, 0.25, 0.125], energies)
    row = next(line for line in told.splitlines() if "time.h = 1.0" in line)
    assert f"{expected.order:.2f}" in row and f"{expected.limit:.7g}" in row
    assert 0.8 < expected.order < 2.2
    with next((tmp_path / "out").glob("*.csv")).open() as file:
        assert len(list(csv.DictReader(file))) == 8
    assert (tmp_path / "out" / "sweep-bar.png").stat().st_size > 5000
    assert main(command) == 0
    assert "8 from an earlier run" in capsys.readouterr().out
    Path(bar).write_text(BAR.replace("-2.0", "-1.0"))
    assert main(command) == 0
    assert "8 from an earlier run" not in capsys.readouterr().out


@pytest.mark.serial
def test_a_case_that_fails_is_told(bar, tmp_path, capsys):
    command = ["sweep", bar, "--vary", "material.E=1e5,1.0", "--vary", "time.cuts=0"]
    code = main([*command, "--measure", "tip.y", "--out", str(tmp_path / "out")])
    told = capsys.readouterr().out
    assert code == 1
    assert "falls short: material.E = 1.0" in told
    assert records(tmp_path / "out")[0]["failure"] == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--vary", "mesh.refine"], "--vary mesh.refine: must be written as KEY=VALUE"),
        (["--vary", "time.h=0.1,0.1"], "--vary time.h=0.1,0.1: needs values, each once"),
        (["--vary", "time.h=3:1"], "--vary time.h=3:1: needs values, each once"),
        (["--vary", "time.h=0.1", "--vary", "time.h=0.2"], "--vary time.h: given twice"),
        (["--vary", "time.h=0.3"], "time.h=0.3: does not divide the 2 steps of 0.5 s"),
        (["--vary", "mesh.refnie=0:1"], "[mesh]: unknown key refnie (did you mean refine?)"),
        (["--vary", "material.2.E=1e5"], "--vary material.2.E: there is no material.2"),
        (["--vary", "material.E=-1"], "[[material]] E = -1: must be a Young's modulus"),
        (["--vary", "solve.formulation=symetric"], "unknown (did you mean symmetric?)"),
        (["--vary", "description.x=1"], "there is no description"),
        (["--measure", "tip.w"], "--measure tip.w: unknown; there are, by example, tip.y"),
        (["--measure", "tip.z"], "--measure tip.z: the axis z is not there in 2D"),
        (["--measure", "at(3,0.5).x"], "the point (3, 0.5) lies outside of the body at rest"),
        (["--measure", "at(1,1,1).x"], "the point (1, 1, 1) must have 2 coordinates"),
        (["--measure", "reaction.2.x"], "reaction.2.x: the scene has 1 [[boundary]]"),
    ],
)
def test_what_is_refused(bar, tmp_path, capsys, arguments, message):
    rest = [] if "--vary" in arguments else ["--vary", "material.nu=0.2"]
    rest += [] if "--measure" in arguments else ["--measure", "tip.y"]
    text = BAR if "description" not in arguments[1] else 'description = "a bar"\n' + BAR
    if COMM.rank == 0:
        Path(bar).write_text(text)
    COMM.barrier()
    assert main(["sweep", bar, *arguments, *rest, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    if COMM.rank == 0:
        assert message in error
        assert len(error.splitlines()) == 1


def test_axes():
    assert axis("a.b=0:3").values == (0, 1, 2, 3)
    assert axis("a.b=0.1, 1e-2").values == (0.1, 0.01)
    assert axis("a.b=symmetric,true").values == ("symmetric", True)
