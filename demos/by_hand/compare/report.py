"""`mixed-fem compare`: what is printed, as a table, a page on one equation, or JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from itertools import groupby
from textwrap import fill
from typing import Any

from mpi4py import MPI

import numpy as np

from demos.app.progress import Screen
from demos.by_hand import MATERIALS
from demos.by_hand.compare.bodies import BODIES, STATES
from demos.by_hand.compare.cases import SYSTEMS, ufl_cases
from demos.by_hand.compare.item import CONDENSED
from demos.by_hand.compare.newton import PRINTED_TOLERANCE, STEP_TOLERANCE
from demos.by_hand.compare.verdicts import (
    TOLERANCE,
    Comparison,
    Row,
    compare,
    missing,
    table,
)
from demos.by_hand.errata import ERRATA, READING, REMARKS, Erratum

WIDTH = 100
"""Characters of a line of prose."""


def run(comm: MPI.Comm, as_json: bool, equation: int | None = None) -> int:
    """Compare everything and print it, or one equation of it. Collective.

    Args:
        comm: Communicator of UFL's side; the witness runs on rank 0.
        as_json: Whether to print one JSON document instead of the table.
        equation: Number of the one equation to print.

    Returns:
        The exit code, the same on all ranks: 1 if anything differs, 0 otherwise.
    """
    screen = Screen(comm, sys.stderr if as_json else sys.stdout)
    wanted = [e for e in ERRATA if equation in (None, e.number)]
    cases = []
    if any(e.verdict != "not comparable" for e in wanted):
        screen.line(
            f"comparing {len(BODIES)} bodies, {len(MATERIALS)} materials, {len(SYSTEMS)} "
            f"formulations, {len(STATES)} states"
        )
        screen.line("preparing UFL's forms (the first time compiles them, a minute or so)")
        cases = ufl_cases(comm, screen)
    passed = True
    if comm.rank == 0:
        comparisons = [c for c in compare(cases) if equation in (None, c.equation)]
        rows = table(comparisons)
        passed = all(row.agrees for row in rows) and not missing(rows, wanted)
        if as_json:
            document = _document(comm, wanted, comparisons, rows, passed)
            print(json.dumps(document, ensure_ascii=False))
        elif equation is not None:
            print("\n".join(_page(wanted[0], comparisons, rows)))
        else:
            print("\n".join(_lines(comparisons, rows)))
        sys.stdout.flush()
    return 0 if comm.bcast(passed) else 1


def _lines(comparisons: Sequence[Comparison], rows: Sequence[Row]) -> list[str]:
    """The table."""
    lines = [
        "",
        f"{'eq':>4}  {'what is compared':<42} {'size':>9} {'cases':>5} {'difference':>10}  "
        f"{'verdict':<8} {'the seed':<9} worst case",
    ]
    seed = {e.number: e for e in ERRATA}
    by_number = {number: list(group) for number, group in groupby(rows, lambda r: r.equation)}
    for number in (*seed, CONDENSED):
        label = f"({number})" if number in seed else ""
        if number not in by_number:
            erratum = seed[number]
            reason = erratum.reason if erratum.verdict == "not comparable" else "NO ROW"
            lines.append(f"{label:>4}  not comparable: {reason}")
        for row in by_number.get(number, ()):
            printed = _printed(seed[number].verdict) if number in seed else ""
            lines.append(
                f"{label:>4}  {row.what:<42} {_size(row.size):>9} {row.cases:>5} "
                f"{row.worst.difference:>10.1e}  {_verdict(row.agrees):<8} {printed:<9} "
                + _where(row.worst)
            )
            label = ""
    bad = [row for row in rows if not row.agrees]
    lines += [
        "",
        f"{len(comparisons)} comparisons in {len(rows)} rows; {len(bad)} rows differ by more than "
        f"{TOLERANCE:g} (Newton steps {STEP_TOLERANCE:g}, as printed {PRINTED_TOLERANCE:g}) "
        "in their own norm",
    ]
    if numbers := missing(rows):
        lines.append(f"equations without a row: {numbers}")
    return lines


def _page(erratum: Erratum, comparisons: Sequence[Comparison], rows: Sequence[Row]) -> list[str]:
    """One equation: as in the seed, as it should be, what is compared, the numbers."""

    def part(title: str, text: str) -> list[str]:
        return ["", title, *(_wrapped(line) for line in text.splitlines())]

    lines = ["", f"({erratum.number}) {erratum.states}: {erratum.verdict}"]
    if erratum.printed:
        lines += part("as in the seed", erratum.printed)
    if erratum.verdict != "not comparable":
        lines += part("as it should be", erratum.corrected or "the same")
    if erratum.reason:
        lines += part("why", erratum.reason)
    for remark in REMARKS:
        if erratum.number in remark.equations:
            lines += part(f"in the seed: {remark.topic}", f'"{remark.quote}"\n{remark.answer}')
    if rows:
        lines += ["", "what is compared, and the largest difference at each state"]
        lines.append(
            f"  {'':<42} {'size':>9} {'cases':>5} "
            + "".join(f"{state:>12}" for state in STATES)
            + f" {'allowed':>9}  verdict"
        )
    for row in rows:
        same = [c for c in comparisons if c.what == row.what]
        numbers = ""
        for state in STATES:
            there = [c for c in same if c.case[3] == state]
            # What is not a number is the worst.
            worst = max(there, key=lambda c: (not c.agrees, c.difference), default=None)
            numbers += f"{worst.difference:>12.1e}" if worst else f"{'-':>12}"
        lines.append(
            f"  {row.what:<42} {_size(row.size):>9} {row.cases:>5} {numbers} "
            f"{row.worst.tolerance:>9.0e}  {_verdict(row.agrees)}"
        )
        if not row.agrees:
            lines.append(f"    worst: {_where(row.worst)}")
    if missing(rows, [erratum]):
        lines.append("  NO ROW")
    return lines + part("how to read the verdict", "\n".join(f"- {rule}" for rule in READING))


def _wrapped(line: str) -> str:
    return fill(line, WIDTH, initial_indent="  ", subsequent_indent="  ", break_long_words=False)


def _document(
    comm: MPI.Comm,
    wanted: Sequence[Erratum],
    comparisons: Sequence[Comparison],
    rows: Sequence[Row],
    passed: bool,
) -> dict[str, Any]:
    names = ("body", "formulation", "material", "state")
    return {
        "passed": passed,
        "tolerance": TOLERANCE,
        "ranks": comm.size,
        "equations": [
            {
                "equation": e.number,
                "states": e.states,
                "seed": e.verdict,
                "printed": e.printed,
                "corrected": e.corrected,
                "reason": e.reason,
                "compared": any(row.equation == e.number for row in rows),
            }
            for e in wanted
        ],
        "rows": [
            {
                "equation": row.equation or None,
                "what": row.what,
                "size": row.size,
                "cases": row.cases,
                "difference": _number(row.worst.difference),
                "tolerance": row.worst.tolerance,
                "verdict": _verdict(row.agrees),
                "worst": dict(zip(names, row.worst.case, strict=True)) | {"part": row.worst.part},
            }
            for row in rows
        ],
        "comparisons": [
            {
                "equation": c.equation or None,
                "what": c.what,
                "part": c.part,
                **dict(zip(names, c.case, strict=True)),
                "size": c.size,
                "difference": _number(c.difference),
                "tolerance": c.tolerance,
                "verdict": _verdict(c.agrees),
            }
            for c in comparisons
        ],
    }


def _verdict(agrees: bool) -> str:
    return "agrees" if agrees else "DIFFERS"


def _printed(verdict: str) -> str:
    return {"holds as printed": "holds", "corrected": "corrected"}[verdict]


def _where(c: Comparison) -> str:
    return ", ".join(filter(None, (*reversed(c.case), c.part)))


def _size(shape: tuple[int, ...]) -> str:
    return "×".join(str(n) for n in shape)


def _number(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None
