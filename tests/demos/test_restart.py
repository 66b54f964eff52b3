"""Runs that are killed, interrupted and gone on with: the same final state, and nothing lost."""

from __future__ import annotations

import csv
import errno
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from demos.app import files, viewer
from demos.app.cli import main
from demos.app.output import CHECKPOINT, Output
from tests.demos.scenes import bar as bar_text

COMM = MPI.COMM_WORLD

BAR = bar_text(
    'scheme = "bdf2"\nh = 0.01\nsteps = 12\n[damping]\nstiffness = 0.01\n',
    cells="[8, 4]",
    nu=0.4,
)


@pytest.fixture
def bar(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(viewer, "draw", lambda *_args, **_kwargs: "not needed by this test")
    path = Path(COMM.bcast(str(tmp_path))) / "bar.toml"
    if COMM.rank == 0:
        path.write_text(BAR)
    COMM.barrier()
    return path


def numbers(out: Path) -> np.ndarray:
    """The history without seconds."""
    with (out / "history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(v) for k, v in row.items() if "seconds" not in k] for row in rows])


def same(one: Path, other: Path, tolerance: float | None = None) -> None:
    """The two folders hold the same run."""
    exact = 0.0 if COMM.size == 1 else 1e-9
    tolerance = exact if tolerance is None else tolerance
    with np.load(one / "final.npz") as a, np.load(other / "final.npz") as b:
        assert set(a) == set(b)
        for name in a:
            scale = max(np.abs(a[name]).max(), 1e-300)
            assert np.abs(a[name] - b[name]).max() <= tolerance * scale, name
    first, second = numbers(one), numbers(other)
    assert first.shape == second.shape
    assert np.abs(first[:, :3] - second[:, :3]).max() < 1e-12
    for out in (one, other):
        listed = re.findall(r'file="(fields\d+\.vtu)"', (out / "fields" / "fields.pvd").read_text())
        assert listed == sorted(p.name for p in (out / "fields").glob("*.vtu"))
        assert len(listed) == len(first) + 1


def run(bar, out, *arguments):
    code = main(["run", str(bar), "--out", str(out), *arguments])
    COMM.barrier()
    return code


def test_more_steps_go_on_from_where_a_run_ended(bar, tmp_path):
    whole, parts = (bar.parent / name for name in ("whole", "parts"))
    assert run(bar, whole) == 0
    assert run(bar, parts, "--steps", "5") == 0
    assert run(bar, parts, "--resume", "--steps", "9") == 0
    assert run(bar, parts, "--resume") == 0
    same(whole, parts)
    before = (parts / "final.npz").stat().st_mtime_ns
    assert run(bar, parts, "--resume") == 0  # nothing is left to do
    same(whole, parts)
    assert (parts / "final.npz").stat().st_mtime_ns >= before


def test_without_a_checkpoint_resume_begins(bar, capfd):
    out = bar.parent / "out"
    assert run(bar, out, "--resume", "--steps", "2") == 0
    assert COMM.rank != 0 or "no checkpoint in" in capfd.readouterr().out
    assert len(numbers(out)) == 2


def test_the_baseline_is_gone_on_with_too(bar):
    text = BAR + '[solve]\nbaseline = "displacement"\n'
    if COMM.rank == 0:
        bar.write_text(text)
    COMM.barrier()
    whole, parts = (bar.parent / name for name in ("whole", "parts"))
    assert run(bar, whole) == 0
    assert run(bar, parts, "--steps", "5") == 0
    assert run(bar, parts, "--resume") == 0
    same(whole, parts)
    same(whole / "displacement", parts / "displacement")


def test_adaptive_and_static_steps_go_on(bar):
    """With h as it was found to be, and its multiples met."""
    text = BAR.replace("steps = 12", "steps = 12\ntolerance = 1e-4")
    for content, steps in ((text, "12"), (BAR.replace('"bdf2"', '"static"'), "4")):
        if COMM.rank == 0:
            bar.write_text(content)
        COMM.barrier()
        whole, parts = (bar.parent / f"{name}{steps}" for name in ("whole", "parts"))
        assert run(bar, whole, "--steps", steps, "--checkpoint", "1") == 0

        def stop(output, result, step=Output.step):
            step(output, result)
            if output.steps == 3:
                error = KeyboardInterrupt()
                error.on_all_ranks = True
                raise error

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Output, "step", stop)
            assert run(bar, parts, "--steps", steps) == 130
        assert len(numbers(parts)) == 3
        assert run(bar, parts, "--steps", steps, "--resume") == 0
        same(whole, parts, 1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("E = 1e5", "E = 2e5", "material.1.E was 100000.0 and is 200000.0"),
        ("h = 0.01", "h = 0.02", "time.h was 0.01 and is 0.02"),
        ("cells = [8, 4]", "cells = [4, 4]", "mesh.box.cells was [8, 4] and is [4, 4]"),
        ('scheme = "bdf2"\n', "", "time.scheme was bdf2 and is not there"),
    ],
)
def test_another_scene_is_refused(old, new, message, bar, capfd):
    out = bar.parent / "out"
    assert run(bar, out, "--steps", "1") == 0
    kept = (out / CHECKPOINT).read_bytes()
    if COMM.rank == 0:
        bar.write_text(BAR.replace(old, new))
    COMM.barrier()
    capfd.readouterr()
    assert run(bar, out, "--resume") == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert f"is of another scene: {message}" in error and error.count("\n") == 1
    assert (out / CHECKPOINT).read_bytes() == kept


def test_another_mesh_formulation_or_file_is_refused(bar, capfd):
    out = bar.parent / "out"
    assert run(bar, out, "--steps", "1") == 0
    file = str(out / CHECKPOINT)
    if COMM.rank == 0:
        (out / "text.npz").write_text("no checkpoint")
        shutil.copy(out / "final.npz", out / "other.npz")
    COMM.barrier()
    for arguments, message in (
        (["--formulation", "seed", "--resume", file], "solve.formulation was not there and is se"),
        (["--resume", str(out / "text.npz")], "no checkpoint, or truncated or damaged"),
        (["--resume", str(out / "other.npz")], "no checkpoint, or truncated or damaged"),
        (["--resume", "nothing.npz"], "nothing.npz: no such file"),
        (["--checkpoint", "-1"], "--checkpoint -1: must be a number of steps, or 0"),
    ):
        capfd.readouterr()
        assert run(bar, out, *arguments) == 2
        error = COMM.bcast(capfd.readouterr().err)
        assert message in error and error.count("\n") == 1


@pytest.mark.serial
def test_twenty_kills(bar, tmp_path):
    """At any moment, of writing too; the state at the end is that of a run in one piece."""
    text = BAR.replace("steps = 12", "steps = 150")
    bar.write_text(text)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(bar, whole, "--checkpoint", "1") == 0
    command = [sys.executable, "-m", "demos", "run", str(bar), "--out", str(killed), "--resume"]
    command += ["--checkpoint", "1"]
    chance = random.Random(1)
    for _ in range(20):
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            for line in process.stdout:
                if b"ready" in line:
                    break
            time.sleep(chance.uniform(0.0, 0.12))
            process.kill()
    reached = len(numbers(killed))
    assert 0 < reached < 150
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    same(whole, killed)


@pytest.mark.serial
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_one_line_and_a_checkpoint(number, code, bar, tmp_path):
    text = BAR.replace("steps = 12", "steps = 100000")
    bar.write_text(text)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "demos", "run", str(bar), "--out", str(out)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        for line in process.stdout:
            if "/100000" in line:
                break
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == code
    assert len(error.splitlines()) == 1
    done = int(re.search(r"symmetric: (\d+) of 100000 steps are done", error)[1])
    assert len(numbers(out)) == done
    assert run(bar, out, "--resume", "--steps", str(done + 1)) == 0
    assert len(numbers(out)) == done + 1


@pytest.mark.parametrize("when", [1, 4, 9, 14])
def test_a_full_disk(when, bar, capfd, monkeypatch):
    """One line, exit code 2, and the last checkpoint whole."""
    out, calls, fsync = bar.parent / "out", [], os.fsync

    def full(descriptor):
        calls.append(1)
        if len(calls) >= when:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    assert run(bar, out, "--checkpoint", "1") == 2
    monkeypatch.undo()
    error = COMM.bcast(capfd.readouterr().err)
    assert "No space left on device" in error and error.count("\n") == 1
    assert not [
        p for p in out.rglob("*") if p.is_file() and (not p.stat().st_size or ".part" in p.name)
    ]
    monkeypatch.setattr(viewer, "draw", lambda *_args, **_kwargs: "not needed by this test")
    assert run(bar, out, "--resume", "--steps", "12") == 0
    assert len(numbers(out)) == 12


def test_a_row_that_cannot_be_written(bar, capfd, monkeypatch):
    def full(table, values):
        raise files.OutputError("history.csv: cannot be written (No space left on device)")

    monkeypatch.setattr(files.Csv, "row", full)
    assert run(bar, bar.parent / "out") == 2
    assert "history.csv" in COMM.bcast(capfd.readouterr().err)


@pytest.mark.serial
def test_interrupts_while_libraries_are_loaded():
    """One line and exit code 130, whatever was being imported."""
    for k in range(6):
        process = subprocess.Popen(
            [sys.executable, "-m", "demos", "list"],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        time.sleep(0.1 + 0.07 * k)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        if process.returncode == -signal.SIGINT and "demos" not in said:
            continue  # Python itself had hardly begun
        if process.returncode == 0:
            continue  # it had ended
        assert process.returncode == 130
        (line,) = said.strip().splitlines()
        assert line.startswith("mixed-fem: interrupted")
