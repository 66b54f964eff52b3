"""The studies that hold the method against published values, and against the displacement's."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from demos.studies import beams, benchmark, cook, equivalence, locking
from tests.states import run_quick, show

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
def test_beams_converge_to_the_references():
    """At second order, to the elastica and to Timoshenko's frequency."""
    cases = [
        benchmark.case(kind, "symmetric", n) for kind in benchmark.SLENDERNESS for n in (2, 4, 8)
    ]
    records = [case | benchmark.compute(COMM, case) for case in cases]
    assert benchmark.verdict(records) == []
    for kind in benchmark.SLENDERNESS:
        deviations = [abs(r["deviation"]) for r in records if r["kind"] == kind]
        assert np.log2(deviations[-2] / deviations[-1]) == pytest.approx(2.0, abs=0.1)
    # A limit elsewhere is named.
    wrong = [r | {"frequency": 3.7} if r["kind"] == "vibration" else r for r in records]
    assert [line.partition(":")[0] for line in benchmark.verdict(wrong)] == ["vibration"]
    show(benchmark.BENCHMARK, records)


def test_scenes_have_the_displacement_methods_positions():
    case = equivalence.scene_case("hanging-bar", "symmetric", -1, 2)
    record = case | equivalence.compute(COMM, case)
    assert len(record["differences"]) == 2
    assert equivalence.verdict([record]) == []
    assert record["iterations"][0][0] < record["iterations"][0][1]
    (line,) = equivalence.verdict([record | {"difference": 1e-6}])
    assert "hanging-bar, symmetric: differs by 1.0e-06" in line
    show(equivalence.EQUIVALENCE, [record])


@pytest.mark.serial
def test_plates_agree_unless_they_may_not():
    """Signed stretches see an inverted cell as the displacement method does, √(FᵀF) does not."""
    cases = [
        equivalence.plate_case("inverted", name)
        for name in ("symmetric", "gauss-newton", "hu-washizu")
    ]
    cases += [equivalence.plate_case("compliant", "symmetric", c) for c in (1e-3, 1e-4)]
    records = [case | equivalence.compute(COMM, case) for case in cases]
    assert equivalence.verdict(records) == []
    assert records[0]["inverted"] > 0
    assert records[0]["difference"] < 1e-9 < 1e-2 < records[2]["difference"]
    assert equivalence.order_of_compliance(records[3:]) == pytest.approx(1.0, abs=0.01)
    assert len(equivalence.verdict([records[0] | {"formulation": "hu-washizu"}])) == 1
    show(equivalence.EQUIVALENCE, records)


@pytest.mark.serial
def test_plates_of_other_elements_agree_with_one_rule():
    """A finer rule differs unless the coarser is exact, and so does a poorer dilatation."""
    quadrilateral, triangle = ("quadrilateral", 1), ("triangle", 2)
    assert quadrilateral == equivalence.EXACT
    cases = [
        equivalence.plate_case("element", "symmetric", element=quadrilateral),
        equivalence.plate_case("element", "symmetric", element=triangle),
        equivalence.plate_case("element", "mean-dilatation", element=quadrilateral),
        equivalence.plate_case("finer rule", "symmetric", element=triangle),
    ]
    records = [case | equivalence.compute(COMM, case) for case in cases]
    assert equivalence.verdict(records) == []
    differences = [r["difference"] for r in records]
    assert max(differences[:2]) < 1e-12 < 1e-6 < min(differences[2:])
    assert len(equivalence.verdict([records[3] | {"difference": 1e-12}])) == 1
    case = equivalence.plate_case("finer rule", "symmetric", element=quadrilateral)
    assert equivalence.compute(COMM, case)["difference"] < 1e-12
    show(equivalence.EQUIVALENCE, records)


@pytest.mark.serial
@pytest.mark.parametrize(("nu", "published"), cook.PUBLISHED.items())
def test_reference_of_cooks_membrane_is_as_published(nu, published):
    point, value = published
    assert cook.reference(COMM, nu, point, n=32) == pytest.approx(value, rel=4e-3)


@pytest.mark.serial
def test_triangles_lock():
    """Cook's membrane and a bent beam at ν = 0.4999, and hardly at 0.3; mean dilatation cures."""
    linear = [(formulation, "triangle", 1) for formulation in ("symmetric", "displacement")]
    cured = ("mean-dilatation", "quadrilateral", 1)
    assert {*linear, cured} <= {*locking.METHODS}
    cases = [locking.case("cook", method, nu, 16) for method in linear for nu in (0.3, 0.4999)]
    cases += [locking.case("beam", linear[0], nu, 4) for nu in (0.3, 0.4999)]
    cases.append(locking.case("cook", cured, 0.4999, 16))
    records = [case | locking.compute(COMM, case) for case in cases]
    assert locking.verdict(records) == []
    ratios = [r["ratio"] for r in records]
    assert ratios[1] < 0.3 < 0.85 < ratios[0] < 1
    np.testing.assert_allclose(ratios[:2], ratios[2:4], rtol=1e-8)
    assert ratios[5] < 0.02 < 0.85 < ratios[4] < 1
    assert ratios[6] == pytest.approx(1.0, abs=0.03)
    assert locking.verdict([*records[:6], records[6] | {"ratio": 0.9}])
    assert locking.verdict([records[0] | {"failure": "DIVERGED_MAX_IT"}])
    show(locking.LOCKING, records)


@pytest.mark.serial
@pytest.mark.parametrize("name", ["benchmark", "locking", "equivalence"])
def test_quick_grids_hold(name, tmp_path):
    assert run_quick(name, tmp_path) == 0
