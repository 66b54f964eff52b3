"""`mixed-fem study`: the frame on a study of its own, and the cases of the built-in ones."""

from __future__ import annotations

import csv
import io
import json

from mpi4py import MPI

import numpy as np
import pytest

from demos import studies
from demos.cli import main
from demos.progress import Screen
from demos.studies import (
    Interrupted,
    Study,
    cost,
    newton,
    preconditioner,
    refinement,
    run,
    scaling,
    stiffness,
    timestep,
)
from tests.states import FIRST_FORMULATIONS

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


def test_cost_of_a_small_case(tmp_path):
    """Both formulations count the same work in the same way, and the table shows all of it."""
    pytest.importorskip("numba")
    cases = [
        cost._case("mesh", 2, "stable-neo-hookean", 1e7, 0.1, 2),
        cost._case("grid", 2, "stable-neo-hookean", 1e6, 0.1, 2),
    ]
    records = [case | cost.compute(COMM, case) for case in cases]
    for record, variants in zip(records, (cost.VARIANTS[:2], cost.VARIANTS), strict=True):
        for variant in variants:
            assert record[f"{variant}_failure"] == ""
            assert len(record[f"{variant}_iterations"]) == record["steps"] == 2
            phases = sum(record[f"{variant}_{phase}"] for phase in cost.PHASES)
            assert 0.0 < phases < max(record[f"{variant}_seconds"])
    assert records[0]["mixed_local"] > 0.0 and records[0]["peak_memory"] > 0.01
    lines = cost.table(records)
    assert sum("mixed / displacement: an iteration" in line for line in lines) == 1
    assert lines[-1].split()[0] == "1e+06"
    failed = records[1] | {"projected_failure": "DIVERGED_MAX_IT", "mixed_failure": "DIVERGED_DTOL"}
    assert cost.classical(failed) == "backtracking"
    assert "fails at step 3" in cost.table([records[0], failed])[-1]
    matplotlib = pytest.importorskip("matplotlib.figure")
    if COMM.rank == 0:
        figure = matplotlib.Figure()
        cost.draw(records, figure)
        figure.savefig(tmp_path / "cost.png")
        assert (tmp_path / "cost.png").stat().st_size > 1000


@pytest.mark.parametrize("motion", ["static", "dynamic"])
@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_orders_of_refinement_in_2d(formulation, motion):
    """u in L2: 2, in H1: 1; S and Λ: 1, over the finest three of four levels."""
    cases = [refinement.case(formulation, 2, motion, "condensed", n) for n in (4, 8, 16, 32)]
    check_orders(cases)


def test_orders_of_refinement_in_3d():
    check_orders([refinement.case("symmetric", 3, "dynamic", "condensed", n) for n in (2, 4, 8)])


def check_orders(cases):
    records = [case | refinement.compute(COMM, case) for case in cases]
    assert refinement.verdict(records) == []
    for name, order in refinement.orders(records).items():
        assert order == pytest.approx(refinement.ORDERS[name], abs=0.1)
    # An error that does not fall is named.
    stuck = [r | {"S_L2": records[0]["S_L2"]} for r in records]
    assert [line for line in refinement.verdict(stuck) if "S_L2 has order" in line]


def test_newton_of_the_mixed_formulations_is_faster_and_superlinear():
    cases = [newton.case(name, 2, projected=False) for name in ("symmetric", "displacement")]
    records = [case | newton.compute(COMM, case) for case in cases]
    mixed, classical = records
    assert mixed["failure"] == classical["failure"] == ""
    assert mixed["order"] > 1.5
    assert 2 * mixed["iterations"] < classical["iterations"]
    assert len(newton.table(records)) == 2 + len(records)


def test_order_of_backward_euler():
    """One, in displacement, velocity and energy; the two formulations march alike."""
    cases = timestep.grid(quick=True)
    records = [case | timestep.compute(COMM, case) for case in cases]
    assert timestep.verdict(records) == []
    half = len(records) // 2
    for mixed, classical in zip(records[:half], records[half:], strict=True):
        np.testing.assert_allclose(mixed["u"], classical["u"], rtol=0, atol=1e-8)
    # Records of another order are named.
    wrong = [r | {"u": records[0]["u"]} if r["steps"] == 64 else r for r in records]
    assert len(timestep.verdict(wrong)) == 2


def test_stiffness_of_a_thrown_bar():
    """Where the displacement's Newton takes many iterations the mixed one takes few."""
    pytest.importorskip("numba")
    (case,) = (
        c
        for c in stiffness.grid(quick=True)
        if (c["support"], c["E"], c["h"]) == ("rotating", 1e8, 0.1)
    )
    record = case | stiffness.compute(COMM, case)
    assert record["mixed"] < 5 < stiffness.classical(record)
    failed = record | {"mixed": None, "backtracking": None}
    assert stiffness.classical(failed) == record["projected"]
    lines = stiffness.table([record, failed | {"E": 1e9, "projected": None}])
    assert "fails / fails" in lines[-3]
    assert "of 2 cases the mixed Newton fails in 1, the displacement Newton in 1" in lines[-1]


def test_preconditioners_on_a_coarse_mesh(monkeypatch):
    """Exact blocks take one iteration; all arrive where `direct` does; shortfalls are named."""
    methods = ("schur-full-mumps", "schur-full-gamg", "condensed-gamg")
    cases = [preconditioner.case("mesh", 2, m) for m in methods]
    cases.append(preconditioner.case("contrast", 2, "schur-full-gamg", contrast=1e2))
    cases.append(preconditioner.case("h", 2, "schur-full-mumps", h=preconditioner.STATIC))
    records = [case | preconditioner.compute(COMM, case) for case in cases]
    assert preconditioner.verdict(records) == []
    for r in records:
        assert r["failure"] == "" and r["difference"] < 1e-9
    assert [r["krylov_max"] for r in records[::4]] == [1, 1]
    assert records[1]["krylov_mean"] > 1.0
    lines = preconditioner.table(records)
    assert [line for line in lines if line.startswith("static, 192 tetrahedra")]
    monkeypatch.setattr(preconditioner, "COARSE", 1)
    finer = [r | {"n": 4, "krylov_mean": 2 * r["krylov_mean"]} for r in records[:3]]
    (growth,) = preconditioner.verdict([*records, *finer])
    assert "Krylov iterations grow 2.00 times" in growth
    wrong = {"krylov_max": 2, "difference": 1e-6}
    assert len(preconditioner.verdict([records[0] | wrong])) == 2
    failed = records[0] | {"failure": "DIVERGED_LINEAR_SOLVE", "newton": []}
    assert "fails at step 1" in preconditioner.table([failed])[-1]
    draw(preconditioner, [*records, failed])


def test_scaling_measures_the_same_work():
    """Times of phases make up the total, and tetrahedra a second are what is compared."""
    pytest.importorskip("numba")
    cases = [scaling.case("strong", solver, 2, 1) for solver in scaling.SOLVERS]
    records = [case | scaling.measure(COMM, case) for case in cases]
    for r in records:
        assert r["failure"] == "" and r["newton"] > 1 and r["krylov"] > 1.0
        assert 0.0 < sum(r[phase] for phase in scaling.PHASES) < 1.5 * r["total"]
    # Twice the tetrahedra in the same time, and as many in twice the time.
    weak = [r | {"kind": "weak", "ranks": 2, "tetrahedra": 384} for r in records]
    ones = [r | {"kind": "weak"} for r in records]
    assert scaling.gains([*ones, *weak]) == pytest.approx([1, 1, 2, 2])
    slow = [r | {"ranks": 2, "cores": 2, "total": 2 * r["total"], "n": 16} for r in records]
    assert scaling.gains([*records, *slow]) == pytest.approx([1, 1, 0.5, 0.5])
    assert (
        sum("0.50 times faster than one" in line for line in scaling.verdict(records + slow)) == 2
    )
    failed = weak[0] | {"failure": "2 ranks were not done"}
    assert "fails: 2 ranks" in scaling.table([*records, failed])[-1]
    assert scaling.case("weak", "condensed", 10, 2)["tetrahedra"] == 24 * 13**3
    draw(scaling, [*records, *slow, failed])


@pytest.mark.serial
def test_scaling_starts_ranks():
    pytest.importorskip("numba")
    cases = [scaling.case("strong", "condensed", 2, ranks) for ranks in (1, 2)]
    one, two = (case | scaling.compute(COMM, case) for case in cases)
    assert one["failure"] == two["failure"] == ""
    assert one["newton"] == two["newton"]


@pytest.mark.mpi
def test_scaling_is_not_run_on_ranks(capfd):
    assert main(["study", "scaling"]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error == "mixed-fem: study scaling starts ranks by itself; run it without mpiexec\n"


def draw(study, records):
    """Draw on rank 0, as the frame does."""
    matplotlib = pytest.importorskip("matplotlib.figure")
    if COMM.rank == 0:
        study.draw(records, figure := matplotlib.Figure())
        figure.savefig(io.BytesIO())
