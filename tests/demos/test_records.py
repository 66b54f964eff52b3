"""What all studies make of their records: groups, orders and columns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from demos.studies.records import (
    cells,
    crossed,
    fitted_orders,
    groups,
    in_columns,
    matrix,
    power,
    select,
)

RECORDS = [
    {"method": "one", "h": 0.1, "error": 4e-2, "failure": ""},
    {"method": "one", "h": 0.01, "error": 4e-4, "failure": ""},
    {"method": "another", "h": 0.01, "failure": "DIVERGED_MAX_IT"},
]
COLUMNS = {"method": "{method}", "h [s]": "{h:g}", "error": lambda r: f"{r['error']:.0e}"}


def test_selected_and_grouped():
    first, second, third = RECORDS
    assert select(RECORDS, h=0.01) == [second, third]
    assert select(RECORDS, h=0.01, failure="") == [second]
    assert groups(RECORDS, "h") == {(0.1,): [first], (0.01,): [second, third]}
    assert list(groups(RECORDS, "method", "h")) == [("one", 0.1), ("one", 0.01), ("another", 0.01)]


def test_powers_and_orders():
    """Of the finest three levels that did not fail."""
    x = [1.0, 2.0, 5.0]
    assert power(x, [7.0 * value**-1.5 for value in x]) == pytest.approx(-1.5)
    assert math.isnan(power([1.0], [2.0]))
    levels = [{"h": h, "e": 3 * h**2, "failure": ""} for h in (0.4, 0.2, 0.1)]
    far = {"h": 1.0, "e": 1e6, "failure": ""}
    failed = {"h": 0.05, "failure": "DIVERGED_MAX_IT"}
    assert fitted_orders([far, *levels, failed], lambda r: r["h"], ["e"]) == pytest.approx({"e": 2})


def test_columns():
    """Numbers to the right, words to the left; what failed says so after its case."""
    assert in_columns(RECORDS, COLUMNS, case=2) == [
        "method   h [s]  error",
        "one        0.1  4e-02",
        "one       0.01  4e-04",
        "another   0.01  fails: DIVERGED_MAX_IT",
    ]
    assert cells(RECORDS[2], COLUMNS, case=1) == ["another", "fails: DIVERGED_MAX_IT"]


def test_tables_in_two_directions():
    def shown(r):
        return "fails" if r["failure"] else f"{r['error']:g}"

    assert crossed(RECORDS, {"method": "{method}"}, "h", "h = {h:g} s", shown) == [
        "method   h = 0.01 s  h = 0.1 s",
        "one          0.0004       0.04",
        "another       fails",
    ]
    methods, steps, errors = matrix(RECORDS, "method", "h", lambda r: r.get("error"))
    assert (methods, steps) == (["another", "one"], [0.01, 0.1])
    np.testing.assert_array_equal(errors, [[np.nan, np.nan], [4e-4, 4e-2]])
