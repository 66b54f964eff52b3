"""One numbered equation of the seed, and what is to be said of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["holds as printed", "corrected", "not comparable"]


@dataclass(frozen=True)
class Erratum:
    """The verdict on one numbered equation.

    Attributes:
        number: Number in the seed.
        states: What the equation says, in words.
        verdict: Whether it holds, by the rule of `READING`; "not comparable" where there is nothing
            to evaluate.
        printed: The printed form, symbol by symbol; bold face is not kept.
        reason: Why, and what has to be known to read it.
        corrected: What holds instead; empty if it holds as printed.
    """

    number: int
    states: str
    verdict: Verdict
    printed: str
    reason: str = ""
    corrected: str = ""

    @property
    def true(self) -> str:
        """The equation as it should be."""
        return self.corrected or self.printed


def holds(number: int, states: str, printed: str, reason: str = "") -> Erratum:
    """An equation that holds as printed."""
    return Erratum(number, states, "holds as printed", printed, reason)


def corrected(number: int, states: str, printed: str, corrected: str, reason: str) -> Erratum:
    """An equation that holds with a correction."""
    return Erratum(number, states, "corrected", printed, reason, corrected)
