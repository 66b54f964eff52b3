"""`mixed-fem study duel`: all methods on a small plane bar, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest

from demos.studies import duel, duel_results
from demos.studies.duel_results import claims, pairs, verdict
from tests.demos.studies import computed, show


@pytest.fixture(scope="module")
def records():
    """Two cases with the same forms."""
    cases = [
        duel.case(support, E, h, 1e3, 2, dimension=2)
        for support, E, h in (("thrown", 1e5, 0.1), ("spinning", 1e5, 0.1))
    ]
    return computed(duel, cases)


def test_methods_in_turns(records):
    """All that get through arrive at the same positions; the mixed method does, in few steps."""
    for pair in pairs(records):
        assert [r["method"] for r in (pair.mixed, *pair.others)] == list(duel.METHODS)
        assert not pair.mixed["failed"] and max(pair.mixed["iterations"]) <= 6
        assert pair.fastest is not None
        for r in pair.others:
            if not r["failed"]:
                assert r["apart"] < 1e-6 and len(r["iterations"]) == duel.STEPS
                assert 0.0 < r["seconds"] and pair.fewest["iterations"] <= r["iterations"]
    assert {"case", "method", "iterations", "krylov", "seconds", "failed"} <= records[0].keys()
    show(duel.DUEL, records)


def test_what_takes_too_long_is_stopped(monkeypatch):
    """By iterations, and by seconds beside the mixed method's."""
    case = duel.case("spinning", 1e7, 1.0, 1e3, 2, dimension=2)
    monkeypatch.setattr(duel, "MOST", 2)
    failed = [r["failed"] for r in computed(duel, [case])]
    assert all(why.startswith(("step 1: stopped after 2", "step 1: DIVERGED")) for why in failed)
    monkeypatch.setattr(duel, "MOST", 100)
    for bound in ("SLOWER", "LEAST"):
        monkeypatch.setattr(duel, bound, 0.0)
    mixed, *others = computed(duel, [case])
    assert not mixed["failed"]
    assert all(r["failed"].startswith("step 1: stopped after 0.0 s") for r in others)
    assert len(verdict([mixed, *others])) == 0
    assert "all fail" in "\n".join(duel_results.table([mixed, *others]))


def made(mixed, *others, **case):
    """Records of methods by their iterations and seconds."""
    case = duel.case(*duel.HANGING, duel.FINE) | case
    methods = {"mixed": mixed, **{f"other {k}": other for k, other in enumerate(others)}}
    return [
        case
        | {"method": name, "iterations": [its] * 3, "seconds": seconds, "failed": failed}
        | {"krylov": 9, "apart": 0.0}
        for name, (its, seconds, failed) in methods.items()
    ]


def test_claims_are_measured():
    """Each with its figure, against the fastest of those that get through."""
    good = made((3, 1.0, ""), (4, 1.0, ""), (50, 0.5, "stopped"))
    slow = made((4, 1.0, ""), (4, 0.5, ""), (9, 2.0, ""), case="slow", cells=8)
    hard = made((26, 1.0, ""), (30, 1.5, ""), (9, 2.0, ""), case="hard", cells=8)
    lost = made((5, 1.0, "step 3: lost"), (30, 1.5, ""), (9, 2.0, "no"), case="lost", cells=8)
    assert verdict(good) == []
    (line,) = verdict([*good, *slow])
    assert line.endswith("2.00 at most, 1.50 in the median: slow (2.00)")
    said = verdict([*good, *hard, *lost])
    assert [line.split(":")[1].split()[0] for line in said[:2]] == ["no", "at"]
    assert "lost (step 3: lost)" in said[0] and said[1].endswith(
        "26: hard (26); hard (26); hard (26)"
    )
    assert said[2].endswith("or more (1): 1.50")
    assert [c.met for c in claims(good)] == [True] * 5
    full = [
        r | {"method": duel_results.FULL_STEPS} if r["method"] == "other 0" else r for r in good
    ]
    assert any(c.text.endswith("1.05 times the seconds of full-steps") for c in claims(full))
    assert np.all([c.met for c in claims(full)])
    full[0]["seconds"] = 1.1
    assert any(line.endswith("full-steps: 1.10") for line in verdict(full))
