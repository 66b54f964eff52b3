"""`mixed-fem study`: the frame, on a study of its own."""

from __future__ import annotations

import csv
import dataclasses
import json

from mpi4py import MPI

import pytest

from demos import studies
from demos.cli import main
from demos.progress import Screen
from demos.studies import Interrupted, Study, run

COMM = MPI.COMM_WORLD


class Squares:
    """A study of squares that counts what it computes, and can be stopped before a case."""

    def __init__(self, stop_at=None):
        self.computed, self.stop_at = [], stop_at
        self.study = Study(
            name="squares",
            description="squares of whole numbers",
            grid=lambda quick: [{"n": n} for n in range(2 if quick else 4)],
            compute=self.compute,
            table=lambda records: [f"{r['n']}² = {r['square']}" for r in records],
            draw=lambda records, figure: figure.subplots().plot([r["square"] for r in records]),
            verdict=lambda records: ["9 is too large"] if records[-1]["square"] == 9 else [],
        )

    def compute(self, comm, case):
        if case["n"] == self.stop_at:
            raise KeyboardInterrupt
        self.computed.append(case["n"])
        return {"square": case["n"] ** 2, "history": [case["n"]]}


def go(squares, out, quick=False, fresh=False):
    return run(squares.study, COMM, out, Screen(COMM), quick=quick, fresh=fresh)


def test_cases_are_computed_once(tmp_path):
    first, second = Squares(), Squares()
    assert go(first, tmp_path, quick=True).cached == 0
    outcome = go(second, tmp_path)
    assert (first.computed, second.computed, outcome.cached) == ([0, 1], [2, 3], 2)
    assert [r["square"] for r in outcome.records] == [0, 1, 4, 9]
    again = Squares()
    assert go(again, tmp_path, quick=True, fresh=True).cached == 0
    assert again.computed == [0, 1]


def test_an_interrupted_study_goes_on(tmp_path):
    squares = Squares(stop_at=2)
    with pytest.raises(Interrupted, match=r"2 of 4 cases are done and kept in .*cases; "):
        go(squares, tmp_path)
    assert go(after := Squares(), tmp_path).cached == 2
    assert after.computed == [2, 3]


def test_files_and_shortfalls(tmp_path):
    pytest.importorskip("matplotlib")
    outcome = go(Squares(), tmp_path)
    assert outcome.shortfalls == ["9 is too large"]
    COMM.barrier()
    document = json.loads((tmp_path / "squares.json").read_text())
    assert (document["study"], document["ranks"]) == ("squares", COMM.size)
    assert document["records"] == outcome.records
    with (tmp_path / "squares.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"n": str(n), "square": str(n**2)} for n in range(4)]
    assert (tmp_path / "squares.png").stat().st_size > 1000
    assert (tmp_path / "squares.pdf").read_bytes().startswith(b"%PDF")


def test_command_line(tmp_path, monkeypatch, capfd):
    """Table or JSON on stdout, exit codes 0, 1 and 130, and what is unknown by name."""
    monkeypatch.setattr(studies, "STUDIES", {"squares": Squares().study})
    out = ["--out", str(tmp_path)]
    assert main(["study", "squares", "--quick", *out]) == 0
    assert "1² = 1" in COMM.bcast(capfd.readouterr().out)
    assert main(["study", "squares", *out]) == 1
    assert "falls short: 9 is too large" in COMM.bcast(capfd.readouterr().out)
    assert main(["study", "squares", "--quick", "--json", *out]) == 0
    assert len(json.loads(COMM.bcast(capfd.readouterr().out))["records"]) == 2
    monkeypatch.setattr(studies, "STUDIES", {"squares": Squares(stop_at=1).study})
    assert main(["study", "squares", "--fresh", *out]) == 130
    assert "1 of 4 cases are done" in COMM.bcast(capfd.readouterr().out)


@pytest.mark.serial
def test_ctrl_c_after_the_cases(tmp_path, monkeypatch, capfd):
    """One line, and the cases stay."""

    def interrupted(records):
        raise KeyboardInterrupt

    squares = Squares()
    study = dataclasses.replace(squares.study, verdict=interrupted)
    monkeypatch.setattr(studies, "STUDIES", {"squares": study})
    assert main(["study", "squares", "--out", str(tmp_path)]) == 130
    assert capfd.readouterr().err == "mixed-fem: interrupted; what is written stays\n"
    assert go(Squares(), tmp_path).cached == 4
