"""The studies of linear solvers: block preconditioners and ranks."""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np
import pytest

from demos.app.cli import main
from demos.studies import cells, endurance, preconditioner, scaling
from demos.studies.records import groups, select
from tests.demos.studies import computed, show

COMM = MPI.COMM_WORLD


def test_preconditioners_on_a_coarse_mesh(monkeypatch):
    """Exact blocks take one iteration; all arrive where `direct` does; shortfalls are named."""
    methods = ("schur-full-mumps", "schur-full-gamg", "condensed-gamg")
    cases = [preconditioner.case("mesh", 2, m) for m in methods]
    cases.append(preconditioner.case("contrast", 2, "schur-full-gamg", contrast=1e2))
    cases.append(preconditioner.case("h", 2, "schur-full-mumps", h=preconditioner.STATIC))
    records = computed(preconditioner, cases)
    assert preconditioner.verdict(records) == []
    for r in records:
        assert r["failure"] == "" and r["difference"] < 1e-9
    assert [r["krylov_max"] for r in records[::4]] == [1, 1]
    assert records[1]["krylov_mean"] > 1.0
    lines = preconditioner.table(records)
    assert [line for line in lines if line.startswith("static, 192 tetrahedra")]
    monkeypatch.setattr(preconditioner, "GRAVITY", 1e200)
    (failed,) = computed(preconditioner, [preconditioner.case("h", 2, methods[0], h=0.01)])
    assert len(preconditioner.verdict([failed])) == 1
    assert "fails: DIVERGED" in preconditioner.table([failed])[-1]
    show(preconditioner.PRECONDITIONER, [*records, failed])
    # One iteration is too much to ask of a multigrid cycle, and rounding errors there are.
    monkeypatch.setitem(preconditioner.MOST_KRYLOV, "schur-full-gamg", 1)
    assert len(preconditioner.verdict(records)) == 2
    monkeypatch.setattr(preconditioner, "SAME", 0.0)
    assert len(preconditioner.verdict(records)) == 2 + len(records)


def test_scaling_measures_the_same_work():
    """Times of phases make up the total."""
    cases = [scaling.case("strong", solver, 2, 1) for solver in scaling.SOLVERS]
    records = [{**case, **scaling.measure(COMM, case)} for case in cases]
    for r in records:
        assert r["failure"] == "" and r["newton"] > 1 and r["krylov"] > 1.0
        assert 0.0 < sum(r[phase] for phase in scaling.PHASES) < 1.5 * r["total"]
    assert scaling.case("weak", "condensed", 10, 2)["tetrahedra"] == 24 * 13**3
    show(scaling.SCALING, records)


def test_gains_are_tetrahedra_a_second_beside_one_rank():
    """Twice the tetrahedra, half the time, twice the time; a lack of gain is named."""
    one = {"kind": "strong", "solver": "condensed", "ranks": 1, "cores": 2, "n": 16, "failure": ""}
    one |= {"tetrahedra": 192, "newton": 12, "total": 1.0}
    two = one | {"ranks": 2}
    assert scaling.gains([one, two | {"tetrahedra": 384}]) == pytest.approx([1, 2])
    assert scaling.gains([one, two | {"total": 0.5}]) == pytest.approx([1, 2])
    assert scaling.gains([one, two | {"total": 2.0}]) == pytest.approx([1, 0.5])
    assert all(map(math.isnan, scaling.gains([two])))
    assert scaling.verdict([one, two | {"total": 0.5}]) == []
    assert len(scaling.verdict([one, two])) == 1
    assert len(scaling.verdict([one, two | {"total": 0.5, "newton": 13}])) == 1


@pytest.mark.serial
def test_what_the_engine_costs(monkeypatch):
    """Work at a point, the way to the first iteration, and memory; limits that are missed."""
    cases = [
        cells._case("local", "symmetric", cells.OWN, 3, 2),
        cells._case("local", "displacement", "corotational", 3, 2),
        cells._case("start", "symmetric", cells.OWN, 2, 3),
        cells._case("memory", "symmetric", "stable-neo-hookean", 3, 1),
    ]
    kinds = {(case["kind"], case["dimension"]) for case in cells.grid(quick=True)}
    assert {(case["kind"], case["dimension"]) for case in cases} | {("start", 3)} == kinds
    records = computed(cells, cases)
    assert [r.get("local unknowns") for r in records] == [12, 0, None, None]
    assert all(cells.microseconds(r) > 0.0 for r in records[:2])
    assert 0.1 < records[2]["value"] and 0.05 < records[3]["value"] < cells.MEMORY
    assert {"symmetric", "displacement"} <= {line.split(" ")[0] for line in cells.table(records)}
    for limits, missed in ((math.inf, 0), (0.0, 4)):
        monkeypatch.setattr(cells, "LIMITS", dict.fromkeys(cells.LIMITS, limits))
        monkeypatch.setattr(cells, "START", dict.fromkeys(cells.START, limits))
        monkeypatch.setattr(cells, "MEMORY", limits)
        assert len(cells.verdict(records)) == missed


@pytest.mark.serial
def test_preconditioners_that_fall_short(monkeypatch):
    """None at a contrast of 1e8; near incompressibility multigrid as the only solver."""
    monkeypatch.setattr(preconditioner, "SLOWER", math.inf)
    monkeypatch.setattr(preconditioner, "COARSE", 2)
    cases = [
        case
        for case in preconditioner.grid(quick=True)
        if case["axis"] == "contrast" or case["nu"] == 0.499
    ]
    assert len(cases) == 10
    (line,) = preconditioner.verdict(computed(preconditioner, cases))
    assert line.startswith("schur-full-gamg, nu = 0.499, 192 tetrahedra")


@pytest.mark.serial
def test_scaling_starts_ranks(monkeypatch):
    """Processes of their own, on one rank and on two, take much the same Newton iterations."""
    monkeypatch.setattr(scaling, "QUICK_STRONG", 2)
    cases = [case for case in select(scaling.grid(quick=True), kind="strong") if case["ranks"] <= 2]
    records = computed(scaling, cases)
    assert [(r["solver"], r["ranks"]) for r in records] == [
        (solver, ranks) for solver in scaling.SOLVERS for ranks in (1, 2)
    ]
    assert not any(r["failure"] for r in records)
    for (solver,), both in groups(records, "solver").items():
        # Multigrid depends on the partition, and how exact a step is depends on multigrid.
        assert np.ptp([r["newton"] for r in both]) <= 2, solver
    show(scaling.SCALING, records)


@pytest.mark.mpi
def test_scaling_is_not_run_on_ranks(capfd):
    assert main(["study", "scaling"]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error == "mixed-fem: study scaling starts ranks by itself; run it without mpiexec\n"


@pytest.mark.serial
def test_next_to_nothing_is_left_behind(quick):
    records = quick("endurance")
    assert {r["kind"] for r in records} == {"steps", "problems"}
    assert all(r["memory"] > 0.05 and r["growth"] < endurance.MOST for r in records)
    wrong = {**records[0], "growth": 0.05}
    assert "memory +5.00%" in endurance.verdict([wrong])[0]
