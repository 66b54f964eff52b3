"""`mixed-fem study`: the frame, on studies of its own."""

from __future__ import annotations

import csv
import dataclasses
import inspect
import json
import math
import re
from pathlib import Path

from mpi4py import MPI

import pytest

from demos import studies
from demos.app import petsc_options
from demos.app.cli import main
from demos.app.files import OutputError
from demos.app.progress import Screen
from demos.studies import (
    STUDIES,
    Interrupted,
    Study,
    beams,
    cook,
    cost,
    locking,
    preconditioner,
    run,
    studies_in,
)
from demos.studies.sources import ROOT, sources
from forms import FixedCorotational, polar_rotation
from meshes import box
from solvers import MixedProblem

COMM = MPI.COMM_WORLD


class Squares:
    """A study of squares that counts what it computes, and can be stopped before a case."""

    def __init__(self, stop_at=None, draw=None):
        self.computed, self.stop_at = [], stop_at
        self.study = Study(
            name="squares",
            description="squares of whole numbers",
            grid=lambda quick: [{"n": n} for n in range(2 if quick else 4)],
            compute=self.compute,
            table=lambda records: [f"{r['n']}² = {r['square']}" for r in records],
            draw=draw,
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
    outcome = go(
        Squares(draw=lambda records, figure: figure.subplots().plot([r["n"] for r in records])),
        tmp_path,
    )
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


def test_somebody_elses_files_stay(tmp_path):
    """Refused before anything is computed; those of the study itself are written anew."""
    go(Squares(), tmp_path / "own", quick=True)
    go(Squares(), tmp_path / "own")
    other = tmp_path / "other"
    other.mkdir(exist_ok=True)
    for name, text in (("squares.csv", "mine"), ("squares.json", '{"study": "mine"}')):
        (other / name).write_text(text)
        squares = Squares()
        with pytest.raises(OutputError, match=r"squares\.(csv|json) there is not of a study of "):
            go(squares, other)
        assert squares.computed == []
        assert (other / name).read_text() == text


def test_a_torn_case_is_computed_again(tmp_path):
    go(Squares(), tmp_path, quick=True)
    if COMM.rank == 0:
        for file in (tmp_path / "cases").iterdir():
            file.write_text(file.read_text()[:5])
    COMM.barrier()
    again = Squares()
    assert go(again, tmp_path, quick=True).cached == 0
    assert again.computed == [0, 1]


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


# A study from a file

CUBES = """\
from demos.studies import Study

POWER = 3

def cube(n):
    return n**POWER

def compute(comm, case):
    return {"cube": cube(case["n"]), "label": f"of {case['n']}"}

MINE = Study("cubes", "third powers", lambda quick: [{"n": 2}, {"n": 3}], compute,
             verdict=lambda records: [] if records else ["no cubes"])
"""


def written(path, text):
    if COMM.rank == 0:
        path.write_text(text, "utf-8")
    COMM.barrier()
    return path


def test_a_study_from_outside(tmp_path, capfd):
    """A file of a few lines is enough; without a table of its own it shows all numbers."""
    assert len(CUBES.splitlines()) <= 15
    file, out = written(tmp_path / "cubes.py", CUBES), tmp_path / "out"
    assert main(["study", str(file), "--out", str(out)]) == 0
    said = COMM.bcast(capfd.readouterr().out).splitlines()
    assert [line.split() for line in said[-4:-1]] == [
        ["n", "cube", "label"],
        ["2", "8", "of", "2"],
        ["3", "27", "of", "3"],
    ]
    assert json.loads((out / "cubes.json").read_text("utf-8"))["records"][1]["cube"] == 27
    two = written(tmp_path / "two.py", CUBES + 'YOURS = Study("ones", "", MINE.grid, compute)\n')
    assert main(["study", str(two), "--out", str(out)]) == 0
    assert {"cubes.csv", "ones.csv"} <= {path.name for path in out.iterdir()}
    assert main(["study", str(two), "--json"]) == 2
    assert "--json: goes with one study" in COMM.bcast(capfd.readouterr().err)


def test_the_readmes_study(tmp_path):
    """It runs as printed, and depends on nothing but itself."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), flags=re.S)
    (text,) = (block for block in blocks if "Study(" in block)
    file = written(tmp_path / "springs.py", text)
    assert main(["study", str(file), "--out", str(tmp_path)]) == 0
    records = json.loads((tmp_path / "springs.json").read_text("utf-8"))["records"]
    assert [r["period"] * math.sqrt(r["k"]) for r in records] == pytest.approx([math.tau] * 3)
    (study,) = studies_in(COMM, file, [])
    assert set(sources(study.compute)) == {file}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "mine.py: cannot be read (No such file or directory)"),
        ("from demos.studies import STUDIES\nfrom demos.studies.newton import NEWTON",
         "mine.py: has no study; write one at its top level, MINE = Study(...)"),
        ("import demos\ndemos.nothing", "mine.py, line 2: AttributeError: module 'demos' has no"),
        ("1 +", "mine.py: SyntaxError: invalid syntax"),
        ("raise SystemExit('not\\ntoday')", "mine.py, line 1: SystemExit: not today"),
        ("\\xff", "mine.py: not a text file; a study is written in Python"),
        (f"{CUBES}YOURS = Study('cubes', '', MINE.grid, compute)",
         "mine.py: has several studies called cubes; each needs a name"),
    ],
)  # fmt: skip
def test_a_file_without_studies_gets_one_line(text, message, tmp_path, capfd):
    file = tmp_path / "mine.py"
    if text is not None and COMM.rank == 0:
        file.write_bytes(text.encode().replace(b"\\xff", b"\xff"))
    COMM.barrier()
    assert main(["study", str(file)]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error.startswith("mixed-fem: ") and error.count("\n") == 1
    assert message in error


# Where cases come from


def edited(file, old, new):
    """Change a file in one place."""
    if COMM.rank == 0:
        text = file.read_text("utf-8")
        assert text.count(old) == 1
        file.write_text(text.replace(old, new), "utf-8")
    COMM.barrier()


def test_a_case_depends_on_what_computes_it(tmp_path):
    """Not on the table beside, nor on a comment; on each function and number that it reaches."""
    file = written(tmp_path / "cubes.py", CUBES)

    def cached():
        (study,) = studies_in(COMM, file, [])
        return run(study, COMM, tmp_path, Screen(COMM), quick=False, fresh=False).cached

    assert (cached(), cached()) == (0, 2)
    edited(file, '"no cubes"', '"not any cubes"')
    edited(file, "def cube", "# The third power.\ndef cube")
    assert cached() == 2
    edited(file, "POWER = 3", "POWER = 4")
    assert (cached(), cached()) == (0, 2)
    edited(file, "n**POWER", "n**POWER + 1")
    assert (cached(), cached()) == (0, 2)


def test_the_sources_of_a_study_are_those_that_it_imports():
    """All that it computes with, and none of the other studies or of the command line."""
    found = sources(STUDIES["locking"].compute)
    inner = (beams.cantilever, cook.reference, polar_rotation, FixedCorotational, box, MixedProblem)
    assert {Path(inspect.getfile(part)) for part in inner} <= set(found)
    assert Path(locking.__file__) in found
    in_c = set((ROOT / "solvers").rglob("*.c"))
    assert in_c and in_c <= set(found)
    outer = (cost, preconditioner, studies, petsc_options)
    assert not {Path(module.__file__) for module in outer} & set(found)
