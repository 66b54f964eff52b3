"""`mixed-fem compare`: UFL's discrete system against the hand-derived one, equation by equation."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from mpi4py import MPI

import numpy as np

from demos.compare_cases import BODIES, Case, ufl_cases
from demos.compare_equations import CONDENSED, Hook, items
from demos.progress import Screen
from forms.discrete import ERRATA, MATERIALS

TOLERANCE = 1e-10
"""Largest relative difference, in the block's own norm."""

VANISHING = 1e-12
"""A block this small beside its norm at other states is zero, and measured by theirs."""


@dataclass(frozen=True)
class Comparison:
    """One array of the witness beside UFL's.

    Attributes:
        equation: Number in the seed, or `CONDENSED`.
        what: What is compared.
        part: Which of the arrays of that row.
        case: Body, formulation, material and state.
        size: Shape of the array.
        difference: Relative difference in the norm of the block.
        tolerance: The largest that passes.
    """

    equation: int
    what: str
    part: str
    case: tuple[str, str, str, str]
    size: tuple[int, ...]
    difference: float
    tolerance: float

    @property
    def agrees(self) -> bool:
        """Whether the difference is within the tolerance; not if it is no number."""
        return self.difference <= self.tolerance


@dataclass(frozen=True)
class Row:
    """All comparisons of one kind, over parts, bodies, formulations, materials and states.

    Attributes:
        equation: Number in the seed, or `CONDENSED`.
        what: What is compared.
        size: Largest shape.
        cases: Number of cases.
        worst: The comparison with the largest difference, relative to its tolerance.
        agrees: Whether all agree.
    """

    equation: int
    what: str
    size: tuple[int, ...]
    cases: int
    worst: Comparison
    agrees: bool


def compare(cases: Iterable[Case], hook: Hook = lambda system: system) -> list[Comparison]:
    """Compare the witness with UFL in every case.

    Args:
        cases: UFL's side; where a block vanishes at a state, its norm at the others counts.
        hook: Changes each system of the witness before anything is computed from it.
    """
    found = [(case.names, item) for case in cases for item in items(case, hook)]
    sizes: dict[tuple[Any, ...], float] = {}
    for names, item in found:
        key = (*names[:3], item.equation, item.what, item.part)
        sizes[key] = max(sizes.get(key, 0.0), float(np.linalg.norm(item.expected)))
    comparisons = []
    for names, item in found:
        if item.witness.shape != item.expected.shape:
            raise ValueError(
                f"({item.equation}) {item.what}: shapes {item.witness.shape}, {item.expected.shape}"
            )
        largest = sizes[*names[:3], item.equation, item.what, item.part]
        norm = float(np.linalg.norm(item.expected))
        scale = norm if norm > VANISHING * largest else largest
        distance = float(np.linalg.norm(item.witness - item.expected))
        # Not 0 / 0, and not a number stays not a number.
        difference = distance / scale if scale > 0.0 else (0.0 if distance == 0.0 else np.inf)
        tolerance = TOLERANCE if item.tolerance is None else item.tolerance
        comparisons.append(
            Comparison(
                *(item.equation, item.what, item.part, names),
                *(item.witness.shape, difference, tolerance),
            )
        )
    return comparisons


def table(comparisons: Sequence[Comparison]) -> list[Row]:
    """Gather comparisons by equation and kind, in the order of the seed, `CONDENSED` last."""
    kinds: dict[tuple[int, str], list[Comparison]] = {}
    for c in sorted(comparisons, key=lambda c: np.inf if c.equation == CONDENSED else c.equation):
        kinds.setdefault((c.equation, c.what), []).append(c)
    return [
        Row(
            *(equation, what),
            size=max((c.size for c in same), key=lambda size: (np.prod(size), size)),
            cases=len({c.case for c in same}),
            # What is not a number agrees with nothing.
            worst=max(same, key=lambda c: (not c.agrees, c.difference / c.tolerance)),
            agrees=all(c.agrees for c in same),
        )
        for (equation, what), same in kinds.items()
    ]


def missing(rows: Sequence[Row]) -> list[int]:
    """Numbers of the equations that have no row though they can be compared."""
    compared = {row.equation for row in rows}
    return [e.number for e in ERRATA if e.verdict != "not comparable" and e.number not in compared]


def run(comm: MPI.Comm, as_json: bool) -> int:
    """Compare everything and print it. Collective.

    Args:
        comm: Communicator of UFL's side; the witness runs on rank 0.
        as_json: Whether to print one JSON document instead of the table.

    Returns:
        The exit code, the same on all ranks: 1 if anything differs, 0 otherwise.
    """
    screen = Screen(comm, sys.stderr if as_json else sys.stdout)
    screen.line(
        f"comparing {len(BODIES)} bodies, {len(MATERIALS)} materials, 2 formulations, 3 states"
    )
    screen.line("preparing UFL's forms (the first time compiles them, two minutes or more)")
    cases = ufl_cases(comm, screen)
    passed = True
    if comm.rank == 0:
        comparisons = compare(cases)
        rows = table(comparisons)
        passed = all(row.agrees for row in rows) and not missing(rows)
        if as_json:
            print(json.dumps(_document(comm, comparisons, rows, passed), ensure_ascii=False))
        else:
            print("\n".join(_lines(comparisons, rows)))
        sys.stdout.flush()
    return 0 if comm.bcast(passed) else 1


def _lines(comparisons: Sequence[Comparison], rows: Sequence[Row]) -> list[str]:
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
                + ", ".join(filter(None, (*reversed(row.worst.case), row.worst.part)))
            )
            label = ""
    bad = [row for row in rows if not row.agrees]
    lines += [
        "",
        f"{len(comparisons)} comparisons in {len(rows)} rows; {len(bad)} rows differ by more than "
        f"{TOLERANCE:g} (Newton steps {max(c.tolerance for c in comparisons):g}) in their own norm",
    ]
    if numbers := missing(rows):
        lines.append(f"equations without a row: {numbers}")
    return lines


def _document(
    comm: MPI.Comm, comparisons: Sequence[Comparison], rows: Sequence[Row], passed: bool
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
            for e in ERRATA
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


def _size(shape: tuple[int, ...]) -> str:
    return "×".join(str(n) for n in shape)


def _number(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None
