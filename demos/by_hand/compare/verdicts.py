"""Verdicts: which pairs of arrays agree, gathered by equation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from demos.by_hand.compare.cases import Case
from demos.by_hand.compare.equations import items
from demos.by_hand.compare.item import CONDENSED, Hook
from demos.by_hand.errata import ERRATA, Erratum

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


def missing(rows: Sequence[Row], wanted: Sequence[Erratum] = ERRATA) -> list[int]:
    """Numbers of the equations wanted that have no row though they can be compared."""
    compared = {row.equation for row in rows}
    return [e.number for e in wanted if e.verdict != "not comparable" and e.number not in compared]
