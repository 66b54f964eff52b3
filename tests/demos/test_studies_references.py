"""The studies that hold the method against published values, and against the displacement's."""

from __future__ import annotations

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest

from demos.studies import beams, benchmark, cook, equivalence, locking
from demos.studies.records import select
from tests.demos.studies import computed, show

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("load", "tip"), beams.MATTIASSON.items())
def test_elastica_as_tabulated(load, tip):
    np.testing.assert_allclose(beams.elastica(load), tip, rtol=0, atol=6e-6)


def test_elastica_of_a_small_load_is_the_linear_beam():
    """w/L = P L²/(3 E I), u/L = 1/15 (P L²/(E I))²."""
    load = 1e-3
    u, w = beams.elastica(load)
    assert w == pytest.approx(load / 3, rel=1e-6)
    assert u == pytest.approx(load**2 / 15, rel=1e-5)


def test_frequency_of_a_slender_beam_is_bernoullis():
    """And shear and rotatory inertia lower it by order (t/L)²."""
    loss = [1 - beams.timoshenko_frequency(s) / beams.CLAMPED_FREE**2 for s in (1e4, 100, 50)]
    assert abs(loss[0]) < 1e-7
    assert loss[2] / loss[1] == pytest.approx(4.0, rel=0.01)


def test_frequency_from_backward_euler():
    """Exact for an oscillator, whatever the step."""
    omega, h, y, v = 3.0, 0.2, 1.0, 0.0
    positions = []
    for _ in range(10):
        v = (v - h * omega**2 * y) / (1 + (h * omega) ** 2)
        y += h * v
        positions.append(y)
    assert benchmark.frequency_of_backward_euler(positions, h) == pytest.approx(omega, rel=1e-9)


@pytest.mark.serial
def test_beams_converge_to_the_references(quick):
    """At second order, to the elastica and to Timoshenko's frequency."""
    records = quick("benchmark")
    for kind in benchmark.SLENDERNESS:
        levels = select(records, kind=kind, formulation="symmetric")
        deviations = [abs(r["deviation"]) for r in levels]
        assert np.log2(deviations[-2] / deviations[-1]) == pytest.approx(2.0, abs=0.1)
    # On coarse meshes alone the limits are elsewhere.
    coarse = [r for r in records if r["cells"] <= 2]
    named = [line.partition(":")[0] for line in benchmark.verdict(coarse)]
    assert named == list(benchmark.SLENDERNESS)


def test_scenes_have_the_displacement_methods_positions():
    records = computed(equivalence, [equivalence.scene_case("hanging-bar", "symmetric", -1, 2)])
    assert len(records[0]["differences"]) == 2
    assert equivalence.verdict(records) == []
    assert records[0]["iterations"][0][0] < records[0]["iterations"][0][1]
    show(equivalence.EQUIVALENCE, records)


@pytest.mark.serial
def test_plates_agree_unless_they_may_not(quick, monkeypatch):
    """Signed stretches see an inverted cell as the displacement method does, √(FᵀF) does not."""
    records = select(quick("equivalence"), kind="inverted")
    (signed,), (unsigned,) = (
        select(records, formulation=name) for name in ("symmetric", "hu-washizu")
    )
    assert signed["inverted"] > 0
    assert signed["difference"] < 1e-9 < 1e-2 < unsigned["difference"]
    compliant = select(quick("equivalence"), kind="compliant")
    assert equivalence.order_of_compliance(compliant) == pytest.approx(1.0, abs=0.01)
    # If all were thought to see the sign of det F, these would be found out.
    unsigned_names = equivalence.UNSIGNED
    monkeypatch.setattr(equivalence, "UNSIGNED", ())
    named = [line.split(":")[0] for line in equivalence.verdict(records)]
    assert named == [f"inverted, {name}" for name in unsigned_names]


@pytest.mark.serial
def test_plates_of_other_elements_agree_with_one_rule(quick):
    """A finer rule differs unless the coarser is exact, and so does a poorer dilatation."""
    quadrilateral, triangle = ("quadrilateral", 1), ("triangle", 2)
    assert quadrilateral == equivalence.EXACT
    records = quick("equivalence")
    for cell, degree in (quadrilateral, triangle):
        on_it = select(records, kind="element", cell=cell, degree=degree)
        (same,), (poorer,) = (
            select(on_it, formulation=name) for name in ("symmetric", "mean-dilatation")
        )
        assert same["difference"] < 1e-12 < 1e-6 < poorer["difference"]
    (finer,) = select(records, kind="finer rule")
    assert finer["difference"] > 1e-6
    case = equivalence.plate_case("finer rule", "symmetric", element=quadrilateral)
    (exact,) = computed(equivalence, [case])
    assert exact["difference"] < 1e-12
    assert len(equivalence.verdict([exact])) == 1  # where it ought to differ


@pytest.mark.serial
@pytest.mark.parametrize(("nu", "published"), cook.PUBLISHED.items())
def test_reference_of_cooks_membrane_is_as_published(nu, published):
    point, value = published
    assert cook.reference(COMM, nu, point, n=32) == pytest.approx(value, rel=4e-3)


@pytest.mark.serial
def test_triangles_lock(monkeypatch):
    """Cook's membrane and a bent beam at ν = 0.4999, and hardly at 0.3; mean dilatation cures."""
    linear, quadrilateral = ("symmetric", "triangle", 1), ("mean-dilatation", "quadrilateral", 1)
    classical = ("displacement", "triangle", 1)
    assert {linear, classical} <= set(locking.METHODS) and quadrilateral in locking.CURED
    cases = [locking.case("cook", quadrilateral, 0.4999, n) for n in (4, 16)]
    for nu in (0.3, 0.4999):
        cases += [locking.case("cook", method, nu, 16) for method in (linear, classical)]
        cases.append(locking.case("beam", linear, nu, 4))
    # The reference of the study is finer, and dearer.
    monkeypatch.setattr(cook, "reference", partial(cook.reference, n=32))
    records = computed(locking, cases)
    assert locking.verdict(records) == []

    def ratio(*what):
        (record,) = select(records, **locking.case(*what))
        return record["ratio"]

    assert ratio("cook", linear, 0.4999, 16) < 0.3 < 0.85 < ratio("cook", linear, 0.3, 16) < 1
    assert ratio("beam", linear, 0.4999, 4) < 0.02 < 0.85 < ratio("beam", linear, 0.3, 4) < 1
    assert ratio("cook", quadrilateral, 0.4999, 16) == pytest.approx(1.0, abs=0.03)
    # The displacement's own triangles lock by as much.
    for nu in (0.3, 0.4999):
        expected = pytest.approx(ratio("cook", linear, nu, 16), rel=1e-8)
        assert ratio("cook", classical, nu, 16) == expected
    # On a coarse mesh not even the cure is near enough.
    coarse = select(records, **locking.case("cook", quadrilateral, 0.4999, 4))
    assert len(locking.verdict(coarse)) == 1
    show(locking.LOCKING, records)
