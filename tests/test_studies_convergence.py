"""The studies of convergence: orders in h and mesh size, Newton iterations and their cost."""

from __future__ import annotations

import json

from mpi4py import MPI

import numpy as np
import pytest

from demos.studies import cost, few_iterations, newton, refinement, stiffness, timestep
from tests.states import run_quick, show

COMM = MPI.COMM_WORLD


def test_cost_of_a_small_case():
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
    fine = {"n": 16, "mixed_seconds": [1.0, 1.0], "mixed_iterations": [4, 4], "mixed_local": 2e-6}
    fine |= {"backtracking_seconds": [2.0, 2.0], "backtracking_iterations": [10, 10]}
    first, last = (records[0] | fine | {"tetrahedra": n} for n in (50_000, 100_000))
    last |= {"mixed_seconds": [4.0, 4.0]}
    numbers = ("1.25", "2.00 µs", "5.00", "2.00 µs", "2.00 times", "DIVERGED_DTOL, displacement")
    for number, line in zip(numbers, cost.verdict([first, last, failed]), strict=True):
        assert number in line
    many = {f"{v}_iterations": [9, 9] for v in cost.VARIANTS[1:]}
    slow = records[1] | {"mixed_seconds": [90.0, 90.0]}
    (line,) = cost.verdict([slow | many])
    assert "0.0 times faster in the median, not 3" in line
    few = {f"{v}_iterations": [2, 2] for v in cost.VARIANTS[1:]}
    (line,) = cost.verdict([slow | few])
    assert "times slower, more than 1.2" in line
    assert "fails at step 3" in cost.table([records[0], failed])[-1]
    show(cost.COST, records)


@pytest.mark.serial
def test_orders_of_refinement(tmp_path):
    """Of P1: u in L2: 2, in H1: 1; S and Λ: 1. Of degree k: k + 1, k, and k or more."""
    assert run_quick("refinement", tmp_path) == 0
    records = json.loads((tmp_path / "refinement.json").read_text())["records"]
    for (*which, cell, degree), levels in refinement._series(records).items():
        assert len(levels) >= 3
        if (cell, degree) in (("triangle", 1), ("tetrahedron", 1)):
            found, wanted = refinement.orders(levels), refinement.expected(1)
            assert found == pytest.approx(wanted, abs=0.1), which


def test_orders_of_refinement_in_3d():
    cases = [refinement.case("symmetric", 3, "dynamic", "condensed", n) for n in (2, 4, 8)]
    records = [case | refinement.compute(COMM, case) for case in cases]
    assert refinement.verdict(records) == []
    show(refinement.REFINEMENT, records)
    for name, order in refinement.orders(records).items():
        assert order == pytest.approx(refinement.expected(1)[name], abs=0.1)
    # An error that does not fall is named.
    stuck = [r | {"S_L2": records[0]["S_L2"]} for r in records]
    assert [line for line in refinement.verdict(stuck) if "S_L2 has order" in line]
    failed = [*records, records[-1] | {"failure": "DIVERGED_MAX_IT", "cells": 64}]
    assert refinement.orders(failed) == refinement.orders(records)
    assert refinement.verdict(failed)
    assert "fails: DIVERGED_MAX_IT" in refinement.table(failed)[-1]


@pytest.mark.serial
@pytest.mark.parametrize(("cell", "degree"), [("tetrahedron", 2), ("hexahedron", 1)])
def test_orders_of_elements_in_3d(cell, degree):
    cases = [
        refinement.case("symmetric", 3, "static", "condensed", n, cell=cell, degree=degree)
        for n in (1, 2, 4)
    ]
    records = [case | refinement.compute(COMM, case) for case in cases]
    assert refinement.verdict(records) == []


def test_newton_is_quadratic_linear_or_neither():
    """Exact mixed formulations, those that leave a term out, and the displacement's way."""
    cases = [
        newton.case(name, 2, projected=False, dimension=2)
        for name in ("symmetric", "gauss-newton", "lagged-rotation", "displacement")
    ]
    records = [case | newton.compute(COMM, case) for case in cases]
    assert newton.verdict(records) == []
    mixed, *inexact, classical = records
    assert mixed["order"] > 1.7
    for record in inexact:
        assert record["order"] == pytest.approx(1.0, abs=0.1)
        # Two iterations multiply the residual by the same factor, though they may alternate.
        ratios = np.divide(record["residuals"][-3:], record["residuals"][-5:-2])
        np.testing.assert_allclose(np.sqrt(ratios), record["factor"], rtol=0.2)
    assert 2 * mixed["iterations"] < classical["iterations"]
    swapped = [mixed | {"formulation": "gauss-newton"}, inexact[0] | {"formulation": "symmetric"}]
    assert [line.rpartition(", ")[2] for line in newton.verdict(swapped)] == [
        "expected 1",
        "expected 2",
    ]
    show(newton.NEWTON, records)


@pytest.mark.serial
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
    show(timestep.TIMESTEP, records)


@pytest.mark.serial
def test_stiffness_of_thrown_bars():
    """Where the displacement's Newton takes many iterations the mixed one takes few."""
    pytest.importorskip("numba")
    cases = [
        stiffness.case("rotating", 1, 0.1, "E", 1e8),
        stiffness.case("free", 1, 0.01, "contrast", 1e9),
    ]
    records = [case | stiffness.compute(COMM, case) for case in cases]
    record = records[0]
    assert all(r["mixed"] < 5 < stiffness.classical(r) for r in records)
    failed = record | {"mixed": None, "backtracking": None}
    assert stiffness.classical(failed) == record["projected"]
    assert len(stiffness.verdict([record, failed])) == 1
    lines = stiffness.table([record, failed | {"E": 1e9, "projected": None}])
    assert "fails / fails" in lines[-3]
    assert "of 2 cases the mixed Newton fails in 1, the displacement Newton in 1" in lines[-1]
    show(stiffness.STIFFNESS, records)


@pytest.mark.serial
def test_a_few_iterations_do_whatever_the_contrast():
    """Of the mixed method, as published too; the displacement's Newton is nowhere near."""
    pytest.importorskip("numba")
    errors = {}
    records = []
    for method in few_iterations.METHODS:
        for contrast in (1.0, 1e6):
            case = few_iterations.case(method, contrast, 2, dimension=2)
            records.append(case | few_iterations.compute(COMM, case))
            errors[method, contrast] = [records[-1][f"position_{n}"] for n in (1, 2, 3, 5)]
    assert few_iterations.verdict(records) == []
    for method in ("mixed", "mixed, as published"):
        np.testing.assert_allclose(errors[method, 1e6][:2], errors[method, 1.0][:2], rtol=0.5)
        assert np.all(np.diff(errors[method, 1e6]) < 0)
    # The exact derivative squares the error of an iteration, where the published one divides it.
    assert errors["mixed", 1e6][2] < 1e-3 * errors["mixed, as published", 1e6][2]
    assert errors["displacement", 1.0][2] < 1e-3 < 0.1 < errors["displacement", 1e6][3]
    # What residual there is stems from the error of the positions, and vanishes with it.
    mixed = next(r for r in records if (r["method"], r["contrast"]) == ("mixed", 1.0))
    assert mixed["residual_5"] < 1e-9 < mixed["residual_1"]
    assert few_iterations.verdict([mixed | {"position_3": 0.1}])
    show(few_iterations.FEW_ITERATIONS, records)


@pytest.mark.serial
@pytest.mark.parametrize("name", ["newton", "stiffness", "few-iterations"])
def test_quick_grids_hold(name, tmp_path):
    pytest.importorskip("numba")
    assert run_quick(name, tmp_path) == 0
