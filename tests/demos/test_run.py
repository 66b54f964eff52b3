"""Runs that are repeated, refused, or fail: nothing computed is lost, nothing of others taken."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
import pytest

from demos.app.cli import main
from demos.app.simulation import Simulation
from tests.demos.strip import STRIP, table

COMM = MPI.COMM_WORLD


def test_a_rerun_replaces_its_own_files_and_no_others(strip, tmp_path, undrawn):
    out = tmp_path / "out"
    assert main(["run", str(strip), "--out", str(out), "--steps", "2"]) == 0
    if COMM.rank == 0:
        for name in ("notes.txt", "fields/mine.vtu"):
            (out / name).write_text("old")
    COMM.barrier()
    assert (out / "fields" / "fields000002.vtu").exists()
    assert main(["run", str(strip), "--out", str(out), "--steps", "1"]) == 0
    assert (out / "notes.txt").read_text() == "old"
    assert (out / "fields" / "mine.vtu").read_text() == "old"
    assert not (out / "fields" / "fields000002.vtu").exists()
    with np.load(out / "final.npz") as final:
        assert final["t"] == pytest.approx(0.05)
    assert len(table(out / "history.csv")["step"]) == 1


@pytest.mark.parametrize("name", ["final.npz", "history.csv", "picture.png", "run.json"])
def test_files_of_others_are_not_overwritten(name, strip, tmp_path, capfd):
    out = Path(COMM.bcast(str(tmp_path))) / "out"
    if COMM.rank == 0:
        out.mkdir()
        (out / name).write_text("mine")
    COMM.barrier()
    assert main(["run", str(strip), "--out", str(out)]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert f"{name} there is not of a run of mixed-fem, and would be overwritten" in error
    assert (out / name).read_text() == "mine"
    assert sorted(p.name for p in out.iterdir()) == sorted({name, "fields"})


def test_bad_input_loses_no_former_results(strip, tmp_path, undrawn):
    out = tmp_path / "out"
    assert main(["run", str(strip), "--out", str(out), "--steps", "1"]) == 0
    before = {p: p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    assert before
    COMM.barrier()
    if COMM.rank == 0:
        strip.write_text(STRIP.replace('"min"', "[7.0, 8.0]"))
    COMM.barrier()
    assert main(["run", str(strip), "--out", str(out)]) == 2
    assert {p: p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()} == before


def test_a_failed_step_keeps_those_before_it(strip, tmp_path, capfd, monkeypatch, undrawn):
    """Gravity grows ten-thousandfold after two steps, and there are too few iterations for that."""
    march = Simulation.march

    def overload(self, steps):
        for k, result in enumerate(march(self, steps), start=1):
            yield result
            if k == 2:
                (gravity,) = self.model.loads
                gravity.g = [1e4 * g for g in gravity.g]
                self.problem.problem.solver.setTolerances(max_it=2)

    monkeypatch.setattr(Simulation, "march", overload)
    out = tmp_path / "out"
    if COMM.rank == 0:
        strip.write_text(STRIP.replace('baseline = "displacement"', ""))
    COMM.barrier()
    assert main(["run", str(strip), "--out", str(out)]) == 1
    err = COMM.bcast(capfd.readouterr().err)
    assert err.startswith(
        "mixed-fem: symmetric: step 3 of 3 failed, the state at t = 0.1 s is kept in"
    )
    assert "DIVERGED" in err
    np.testing.assert_array_equal(table(out / "history.csv")["step"], [1, 2])
    newton = table(out / "newton.csv")
    assert set(newton["step"]) == {1, 2, 3}  # the history of the failed step too
    with np.load(out / "final.npz") as final:
        assert final["t"] == pytest.approx(0.1)
        assert np.isfinite(final["x"]).all()
        assert np.isfinite(final["Lam"]).all()
    assert (out / "fields" / "fields.pvd").read_text().count("<DataSet") == 3


def test_a_baseline_that_fails_is_told_in_the_table(strip, tmp_path, capfd, undrawn):
    """Full displacement steps diverge where the strip turns far; the run is good."""
    changes = ("h = 0.05", "h = 1.0"), ("-9.81]", "-50.0]")
    others = '["displacement full-steps", "symmetric", "seed"]'
    text = STRIP.replace('"displacement"', others)
    for old, new in changes:
        text = text.replace(old, new)
    if COMM.rank == 0:
        strip.write_text(text)
    COMM.barrier()
    out = tmp_path / "out"
    assert main(["run", str(strip), "--out", str(out)]) == 0
    said = COMM.bcast(capfd.readouterr().out)
    assert re.search(r"^displacement full-steps: step \d of 3 failed, the state at", said, re.M)
    assert re.search(r"^displacement full-steps +.*fails", said, re.M)
    assert re.search(r"^seed +\d+ +\d+ +\d+ +\d+ ", said, re.M)
    assert {path.name for path in out.iterdir() if path.is_dir()} == {
        "fields", "displacement-full-steps", "seed"
    }  # fmt: skip


# Pictures


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("raise ModuleNotFoundError(\"No module named 'pyvista'\")", "pyvista is not installed"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "died of signal 11"),
        ("raise RuntimeError('no display')", "RuntimeError: no display"),
    ],
)
def test_where_nothing_can_be_drawn_there_are_files(
    program, reason, strip, tmp_path, capfd, monkeypatch
):
    """The run goes on, says why, and leaves the body in a VTK file."""
    (tmp_path / "stub").mkdir(exist_ok=True)
    if COMM.rank == 0:
        (tmp_path / "stub" / "pyvista.py").write_text(program)
    COMM.barrier()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "stub"), prepend=os.pathsep)
    out = tmp_path / "out"
    assert main(["run", str(strip), "--out", str(out), "--steps", "1"]) == 0
    said = COMM.bcast(capfd.readouterr().out)
    assert re.search(rf"no picture \(.*{re.escape(reason)}.*\); the body to draw is in", said)
    assert not (out / "picture.png").exists()
    body = meshio.read(out / "picture.vtu")
    with np.load(out / "final.npz") as final:
        np.testing.assert_array_equal(body.points[:, :2], final["x"])
        strain = np.linalg.norm(final["S"] - np.eye(2), axis=(1, 2))
    np.testing.assert_array_equal(body.cell_data["|S - I|"][0], strain)
