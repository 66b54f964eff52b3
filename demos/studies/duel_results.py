"""Table, figure and claims of `mixed-fem study duel`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from demos.studies.heat import colours, iterations
from demos.studies.records import Column, Record, aligned, cells, groups, in_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEDIAN, LARGEST = 8, 25
"""Iterations of a step that the mixed method keeps to, in the median and at most."""

FEW, SAME, FASTER = 8.0, 1.15, 2.0
"""Where the best other takes fewer iterations a step, the mixed method takes at most so many times
its time; elsewhere it is, in the median, at least so many times faster."""

ALONE = 1e-4
"""Distance of positions [m] above which two methods have found different solutions."""

ON_FINE_MESHES = {
    ("spinning", 1e9, 1.0): (6, None),
    ("spinning", 1e12, 0.1): (5, 1.0),
    ("clamped", 1e7, 0.1): (4, 1.05),
}
"""By support, E and h: iterations of a step at most, and times the seconds of full steps."""

SHOWN = 12
"""Exceptions to a claim that are named."""

FULL_STEPS = "full-steps"
FINE = 50_000  # tetrahedra


@dataclass(frozen=True)
class Pair:
    """The mixed method and the others in a case.

    Attributes:
        mixed: Its record.
        others: Those of all others.
    """

    mixed: Record
    others: list[Record]

    @property
    def fastest(self) -> Record | None:
        """Of the others that get through, that with the least seconds."""
        return min(self._through(), key=lambda r: r["seconds"], default=None)

    @property
    def fewest(self) -> Record | None:
        """That with the fewest iterations."""
        return min(self._through(), key=mean_iterations, default=None)

    @property
    def gain(self) -> float | None:
        """How many times as long as the mixed method the fastest other takes."""
        if self.mixed["failed"] or self.fastest is None:
            return None
        return float(self.fastest["seconds"] / self.mixed["seconds"])

    def _through(self) -> list[Record]:
        return [r for r in self.others if not r["failed"]]


def pairs(records: Iterable[Record]) -> list[Pair]:
    """The first of the records of each case is the mixed method's."""
    return [Pair(rows[0], rows[1:]) for rows in groups(records, "case", "cells").values()]


def mean_iterations(r: Record) -> float:
    """Of a step."""
    return float(np.mean(r["iterations"]))


# Claims


@dataclass(frozen=True)
class Claim:
    """What is claimed, and what is measured.

    Attributes:
        text: The claim.
        measured: The figure.
        met: Whether it holds.
        exceptions: Where it does not.
    """

    text: str
    measured: str
    met: bool
    exceptions: Sequence[str] = ()

    def line(self) -> str:
        """Claim, figure and whether it holds, then where it does not."""
        said = f"{self.text}: {self.measured}"
        more = len(self.exceptions) - SHOWN
        shown = [*self.exceptions[:SHOWN], *([f"and {more} more"] if more > 0 else [])]
        return said if self.met or not shown else f"{said}: {'; '.join(shown)}"


def claims(records: Sequence[Record]) -> list[Claim]:
    """Those that the records can speak of."""
    every = pairs(records)
    found = [_failures(every), *_iterations(every), _same(every), _faster(every)]
    return [c for c in (*found, *_on_fine_meshes(every)) if c is not None]


def _failures(every: Sequence[Pair]) -> Claim:
    failed = [p.mixed for p in every if p.mixed["failed"]]
    return Claim(
        "mixed: no failure",
        f"{len(failed)} of {len(every)} cases",
        not failed,
        [f"{r['case']} ({r['failed']})" for r in failed],
    )


def _iterations(every: Sequence[Pair]) -> list[Claim]:
    steps = [(n, p.mixed) for p in every for n in p.mixed["iterations"]]
    counts = [n for n, _ in steps]
    many = [f"{r['case']} ({n})" for n, r in steps if n > LARGEST]
    return [
        Claim(
            f"mixed: at most {MEDIAN} iterations a step in the median",
            f"{np.median(counts):g}",
            bool(np.median(counts) <= MEDIAN),
        ),
        Claim(f"mixed: at most {LARGEST} iterations", f"{max(counts)}", not many, many),
    ]


def _same(every: Sequence[Pair]) -> Claim | None:
    ratios = [
        (1 / p.gain, p)
        for p in every
        if p.gain is not None and p.fastest is not None and mean_iterations(p.fastest) < FEW
    ]
    if not ratios:
        return None
    slower = sorted(((x, p) for x, p in ratios if x > SAME), key=lambda one: -one[0])
    return Claim(
        f"time at most {SAME} times that of the best other, where it takes fewer than {FEW:g} "
        f"iterations a step ({len(ratios)} cases)",
        f"{max(x for x, _ in ratios):.2f} at most, {np.median([x for x, _ in ratios]):.2f} in the "
        "median",
        not slower,
        [f"{p.mixed['case']} ({x:.2f})" for x, p in slower],
    )


def _faster(every: Sequence[Pair]) -> Claim | None:
    gains = [
        p.gain
        for p in every
        if p.gain is not None and p.fastest is not None and mean_iterations(p.fastest) >= FEW
    ]
    if not gains:
        return None
    return Claim(
        f"at least {FASTER:g} times faster in the median of the cases where the best other takes "
        f"{FEW:g} or more ({len(gains)})",
        f"{np.median(gains):.2f}",
        bool(np.median(gains) >= FASTER),
    )


def _on_fine_meshes(every: Sequence[Pair]) -> list[Claim]:
    found = []
    for p in every:
        r = p.mixed
        key = (r["support"], r["E"], r["h"])
        if r["tetrahedra"] < FINE or r["contrast"] != 1.0 or key not in ON_FINE_MESHES:
            continue
        most, ratio = ON_FINE_MESHES[key]
        name, counts = f"{r['tetrahedra']} tetrahedra, {r['case']}", r["iterations"]
        measured = " ".join(map(str, counts)) + (f", {r['failed']}" if r["failed"] else "")
        met = not r["failed"] and max(counts) <= most
        found.append(Claim(f"{name}: at most {most} iterations", measured, met))
        full = next((o for o in p.others if o["method"] == FULL_STEPS), None)
        if ratio is None or full is None:
            continue
        text = f"{name}: at most {ratio:g} times the seconds of {FULL_STEPS}"
        if full["failed"]:
            found.append(Claim(text, f"these fail ({full['failed']})", not r["failed"]))
            continue
        times = r["seconds"] / full["seconds"]
        found.append(Claim(text, f"{times:.2f}", not r["failed"] and times <= ratio))
    return found


def verdict(records: Sequence[Record]) -> list[str]:
    """The claims that are not met, with figures."""
    return [claim.line() for claim in claims(records) if not claim.met]


# What to show


def _counts(r: Record) -> str:
    return " ".join(map(str, r["iterations"]))


def _of_mixed(p: Pair) -> list[str]:
    r = p.mixed
    return [_counts(r) + (" fails" if r["failed"] else ""), f"{r['seconds']:.2f}"]


def _of_best(p: Pair) -> list[str]:
    r = p.fastest
    return ["all fail"] if r is None else [_counts(r), f"{r['seconds']:.2f}", r["method"]]


CASE: dict[str, Column] = {
    "support": "{support}",
    "E [Pa]": "{E:.0e}",
    "h [s]": "{h:g}",
    "contrast": "{contrast:.0e}",
    "material": "{material}",
    "tetrahedra": "{tetrahedra}",
}
HEADING = [*CASE, "mixed", "s", "best other", "s", "", "gain", "get through"]


def _row(p: Pair) -> list[str]:
    through = sum(not r["failed"] for r in p.others)
    best = [*_of_best(p), "", ""][:3]
    gain = "" if p.gain is None else f"{p.gain:.2f}"
    return [*cells(p.mixed, CASE), *_of_mixed(p), *best, gain, f"{through} of {len(p.others)}"]


def _by_method(records: Sequence[Record]) -> list[str]:
    rows = []
    for (method,), its in groups(records, "method").items():
        done = [r for r in its if not r["failed"]]
        rows.append(
            {
                "method": method,
                "cases": len(its),
                "failures": len(its) - len(done),
                "stopped": sum("stopped" in r["failed"] for r in its),
                "median": _statistic(np.median, done),
                "largest": _statistic(np.max, done),
                "krylov": sum(r["krylov"] for r in its),
                "seconds": sum(r["seconds"] for r in its),
            }
        )
    columns: dict[str, Column] = {
        "method": "{method}",
        "cases": "{cases}",
        "failures": "{failures}",
        "of these stopped": "{stopped}",
        "iterations a step: median": "{median}",
        "most": "{largest}",
        "Krylov": "{krylov}",
        "s": "{seconds:.1f}",
    }
    return in_columns(rows, columns)


def _statistic(of: Callable[[list[int]], float], done: Sequence[Record]) -> str:
    counts = [n for r in done for n in r["iterations"]]
    return f"{of(counts):g}" if counts else ""


def table(records: Sequence[Record]) -> list[str]:
    """Mixed beside the fastest other, case by case; then all methods; then the claims."""
    every = pairs(records)
    alone = sum(p.mixed["failed"] == "" and p.fastest is None for p in every)
    both = sum(p.mixed["failed"] != "" and p.fastest is None for p in every)
    apart = Counter(r["case"] for r in records if (r["apart"] or 0.0) > ALONE)
    lines = [
        "",
        "Newton iterations of each step, and seconds of all: mixed, and the fastest other; gain:",
        "how many times as long as the mixed method that takes",
        "",
        *aligned([HEADING, *map(_row, every)]),
        "",
        *_by_method(records),
        "",
        f"cases in which all others fail and the mixed method does not: {alone} of {len(every)}; "
        f"in which all fail: {both}; in which methods arrive at different positions: {len(apart)}",
        "",
    ]
    for claim in claims(records):
        lines.append(f"{'met' if claim.met else 'NOT'}  {claim.text}: {claim.measured}")
    return lines


def _mixed(p: Pair) -> float | None:
    return None if p.mixed["failed"] else mean_iterations(p.mixed)


def _fewest(p: Pair) -> float | None:
    return None if p.fewest is None else mean_iterations(p.fewest)


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Heat maps of iterations: mixed above the best other, by support and contrast."""
    every = pairs(records)
    usual = Counter(p.mixed["tetrahedra"] for p in every).most_common(1)[0][0]
    shown = [
        {**p.mixed, "pair": p}
        for p in every
        if p.mixed["tetrahedra"] == usual and p.mixed["material"] == every[0].mixed["material"]
    ]
    maps = groups(shown, "support", "contrast")
    supports, contrasts = (list(dict.fromkeys(key[k] for key in maps)) for k in (0, 1))
    figure.set_size_inches(3.6 * len(contrasts), 4.0 * len(supports))
    plots = figure.subplots(2 * len(supports), len(contrasts), squeeze=False)
    for (support, contrast), rows in maps.items():
        row, column = 2 * supports.index(support), contrasts.index(contrast)
        mixed, others = plots[row : row + 2, column]
        image = iterations(mixed, rows, "E", lambda r: _mixed(r["pair"]))
        mixed.set(ylabel="h [s]", title=f"{support}, contrast {contrast:.0e}: mixed")
        image = iterations(others, rows, "E", lambda r: _fewest(r["pair"]))
        others.set(xlabel="E [Pa]", ylabel="h [s]", title="best other")
    colours(figure, image, plots)
