"""The studies of linear solvers: block preconditioners and ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from demos.cli import main
from demos.studies import cost, preconditioner, scaling
from tests.states import run_quick, show

COMM = MPI.COMM_WORLD


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
    show(preconditioner.PRECONDITIONER, [*records, failed])


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
    show(scaling.SCALING, [*records, *slow, failed])


@pytest.mark.serial
def test_scaling_starts_ranks():
    pytest.importorskip("numba")
    cases = [scaling.case("strong", "condensed", 2, ranks) for ranks in (1, 2)]
    one, two = (case | scaling.compute(COMM, case) for case in cases)
    assert one["failure"] == two["failure"] == ""
    assert one["newton"] == two["newton"]


@pytest.mark.serial
@pytest.mark.parametrize("name", ["cost", "preconditioner", "scaling"])
def test_quick_grids(name, tmp_path, monkeypatch):
    """On coarser meshes than in a measurement; 1 if a time or a count falls short of the claims."""
    pytest.importorskip("numba")
    monkeypatch.setattr(cost, "QUICK_SIZES", {2: 2, 3: 2})
    monkeypatch.setattr(cost, "BOTH_MATERIALS_AT", 3)
    monkeypatch.setattr(preconditioner, "MESHES", (2, 4))
    monkeypatch.setattr(preconditioner, "COARSE", 2)
    monkeypatch.setattr(scaling, "QUICK_STRONG", 3)
    monkeypatch.setattr(scaling, "QUICK_WEAK", 2)
    assert run_quick(name, tmp_path) in (0, 1)


@pytest.mark.mpi
def test_scaling_is_not_run_on_ranks(capfd):
    assert main(["study", "scaling"]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error == "mixed-fem: study scaling starts ranks by itself; run it without mpiexec\n"
