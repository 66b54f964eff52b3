"""The studies of convergence: orders in h and mesh size, Newton iterations and their cost."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from demos.studies import (
    conservation,
    cost,
    few_iterations,
    newton,
    refinement,
    stiffness,
    timestep,
)
from demos.studies.records import select
from forms import FORMULATIONS
from tests.demos.studies import computed, show

COMM = MPI.COMM_WORLD


def test_cost_of_a_small_case():
    """All variants count the same work in the same way, and the table shows all of it."""
    cases = [
        cost._case("mesh", 2, "stable-neo-hookean", 1e7, 0.1, 2),
        cost._case("grid", 2, "stable-neo-hookean", 1e6, 0.1, 2),
    ]
    records = computed(cost, cases)
    for record, variants in zip(records, (cost.VARIANTS[:2], cost.VARIANTS), strict=True):
        for variant in variants:
            assert record[f"{variant}_failure"] == ""
            assert len(record[f"{variant}_iterations"]) == record["steps"] == 2
            phases = sum(record[f"{variant}_{phase}"] for phase in cost.PHASES)
            assert 0.0 < phases < max(record[f"{variant}_seconds"])
    assert records[0]["mixed_local"] > 0.0 and records[0]["peak_memory"] > 0.01
    lines = cost.table(records)
    assert sum("mixed / displacement: an iteration" in line for line in lines) == 1
    assert [line for line in lines if line.split()[:2] == ["1e+06", "0.1"]]
    show(cost.COST, records)


def test_a_variant_that_fails_is_not_the_faster_one():
    steps = {"mixed": [1.0, 1.0], "displacement": [3.0, 3.0], "on demand": [2.0, 2.0]}
    record = {f"{variant}_seconds": seconds for variant, seconds in steps.items()}
    record |= {f"{variant}_steps_done": 2 for variant in steps}
    record |= {f"{variant}_failure": "" for variant in steps}
    assert cost.classical(record) == "on demand"
    record |= {"on demand_failure": "DIVERGED_MAX_IT", "on demand_steps_done": 1}
    assert cost.classical(record) == "displacement"


# Formulation, dimension, motion, solver, cell, degree and meshes: each of its kind once or more.
SERIES = [
    ("symmetric", 2, "dynamic", "condensed", "triangle", 1, (4, 8, 16)),
    ("seed", 2, "static", "fieldsplit", "triangle", 1, (4, 8, 16)),
    ("displacement", 2, "static", "direct", "triangle", 1, (4, 8, 16)),
    ("symmetric", 2, "static", "condensed", "triangle", 2, (2, 4, 8)),
    ("symmetric", 2, "static", "condensed", "triangle", 3, (2, 4, 8)),
    ("symmetric", 2, "static", "condensed", "quadrilateral", 1, (2, 4, 8)),
    ("symmetric", 2, "static", "condensed", "quadrilateral", 2, (2, 4, 8)),
    ("symmetric", 3, "static", "condensed", "tetrahedron", 2, (1, 2, 4)),
    ("symmetric", 3, "static", "condensed", "hexahedron", 1, (1, 2, 4)),
]


@pytest.mark.serial
def test_orders_of_refinement(monkeypatch):
    """Of P1: u in L2: 2, in H1: 1; S and Λ: 1. Of degree k: k + 1, k, and k or more."""
    cases = [
        refinement.case(*which, n, cell=cell, degree=degree)
        for *which, cell, degree, counts in SERIES
        for n in counts
    ]
    records = computed(refinement, cases)
    assert refinement.verdict(records) == []
    for (*which, cell, degree), levels in refinement._series(records).items():
        if (cell, degree) == ("triangle", 1):
            found, wanted = refinement.orders(levels), refinement.expected(1)
            assert found == pytest.approx(wanted, abs=0.1), which
    show(refinement.REFINEMENT, records[-12:])
    monkeypatch.setitem(refinement.ORDERS, "S_L2", 1)
    assert len(refinement.verdict(records)) == len(SERIES)


@pytest.mark.serial
def test_orders_of_refinement_in_3d():
    """In motion."""
    cases = [refinement.case("symmetric", 3, "dynamic", "condensed", n) for n in (2, 4, 8)]
    records = computed(refinement, cases)
    assert refinement.verdict(records) == []
    for name, order in refinement.orders(records).items():
        assert order == pytest.approx(refinement.expected(1)[name], abs=0.1)


def check_newton(records):
    """Exact mixed formulations are quadratic, others linear; the displacement's is no faster."""
    mixed, *inexact, classical = (
        next(r for r in records if r["formulation"] == name)
        for name in ("symmetric", "gauss-newton", "lagged-rotation", "displacement")
    )
    assert mixed["order"] > 1.7
    for record in inexact:
        assert record["order"] == pytest.approx(1.0, abs=0.1)
        # Two iterations multiply the residual by the same factor, though they may alternate.
        ratios = np.divide(record["residuals"][-3:], record["residuals"][-5:-2])
        np.testing.assert_allclose(np.sqrt(ratios), record["factor"], rtol=0.2)
    assert mixed["iterations"] <= classical["iterations"] < inexact[0]["iterations"]


def test_newton_is_quadratic_or_linear(monkeypatch):
    names = ("symmetric", "gauss-newton", "lagged-rotation", "displacement")
    records = computed(newton, [newton.case(n, 2, globalisation=None, dimension=2) for n in names])
    assert newton.verdict(records) == []
    check_newton(records)
    show(newton.NEWTON, records)
    # What leaves a term out and says that it does not is found out.
    monkeypatch.setattr(FORMULATIONS["gauss-newton"], "exact", True)
    (line,) = newton.verdict(records)
    assert line.startswith("gauss-newton: order 1.0")


@pytest.mark.serial
def test_what_schemes_keep():
    """Midpoint the angular momentum; backward Euler loses what a rigid body does in it."""
    records = computed(conservation, conservation.grid(quick=True))
    assert conservation.verdict(records) == []
    show(conservation.CONSERVATION, records)
    by_scheme = {r["scheme"]: r for r in records}
    midpoint, euler = by_scheme["implicit-midpoint"], by_scheme["backward-euler"]
    assert abs(midpoint["momentum"]) < 1e-9
    turn = np.arctan(euler["h"])
    for _ in range(euler["steps"] - 1):
        turn = np.arctan(np.sin(turn) / (2 - np.cos(turn)))
    kept = (2 * np.sin(turn / 2) / euler["h"]) ** 2
    assert euler["energy"] == pytest.approx(kept - 1, rel=0.05)
    assert abs(by_scheme["bdf2"]["energy"]) < abs(euler["energy"]) / 5
    midpoint["momentum"] = 1e-6
    assert len(conservation.verdict(records)) == 1


@pytest.mark.serial
def test_order_of_backward_euler(monkeypatch):
    """One, in displacement, velocity and energy; the two formulations march alike."""
    records = computed(timestep, timestep.grid(quick=True))
    assert timestep.verdict(records) == []
    half = len(records) // 2
    for mixed, classical in zip(records[:half], records[half:], strict=True):
        np.testing.assert_allclose(mixed["u"], classical["u"], rtol=0, atol=1e-8)
    show(timestep.TIMESTEP, records)
    monkeypatch.setitem(timestep.ORDERS, "backward-euler", 2)
    assert len(timestep.verdict(records)) == 2 * len(timestep.QUANTITIES)


@pytest.mark.serial
def test_stiffness_of_thrown_bars():
    """Where the displacement's Newton takes many iterations the mixed one takes few."""
    cases = [
        stiffness.case("rotating", 1, 0.1, "E", 1e8),
        stiffness.case("free", 1, 0.01, "contrast", 1e9),
    ]
    thrown = computed(stiffness, cases)
    assert all(r["mixed"] < 5 < stiffness.classical(r) for r in thrown)
    assert stiffness.verdict(thrown) == []
    show(stiffness.STIFFNESS, thrown)


def test_where_only_the_displacement_gets_through_the_mixed_method_falls_short():
    case = stiffness.case("clamped", 1, 0.1, "E", 1e4)
    record = case | {"mixed": None, "mixed_failure": "DIVERGED_MAX_IT", "mixed_searches": 0}
    record |= {"displacement": 7.0, "on demand": None}
    assert len(stiffness.verdict([record])) == 1
    assert any("fails / 7.0" in line for line in stiffness.table([record]))
    assert stiffness.verdict([record | {"displacement": None}]) == []


@pytest.mark.serial
def test_a_few_iterations_do_whatever_the_contrast(monkeypatch):
    """Of the mixed method, as published too; of the displacement's Newton they do not."""
    cases = [few_iterations.case(m, c, 2) for m in few_iterations.METHODS for c in (1.0, 1e6)]
    records = computed(few_iterations, cases)
    assert few_iterations.verdict(records) == []
    show(few_iterations.FEW_ITERATIONS, records)
    errors = {
        (r["method"], r["contrast"]): [r[f"position_{n}"] for n in (1, 2, 3, 5)] for r in records
    }
    for method in ("mixed", "mixed, as published"):
        np.testing.assert_allclose(errors[method, 1e6][:2], errors[method, 1.0][:2], rtol=0.5)
        assert np.all(np.diff(errors[method, 1e6]) < 0)
    # The exact derivative squares the error of an iteration, where the published one divides it.
    assert errors["mixed", 1e6][2] < 1e-3 * errors["mixed, as published", 1e6][2]
    assert errors["displacement", 1.0][2] < 1e-3 < errors["displacement", 1e6][2]
    assert errors["on demand", 1e6][3] > 0.1
    # What residual there is stems from the error of the positions, and vanishes with it.
    (mixed,) = select(records, method="mixed", contrast=1.0)
    assert mixed["residual_5"] < 1e-9 < mixed["residual_1"]
    # Of a smaller error the published method falls short, and the exact one does not.
    monkeypatch.setattr(few_iterations, "PROMISED", 1e-6)
    short = few_iterations.verdict(records)
    assert short and all(line.startswith("mixed, as published") for line in short)
