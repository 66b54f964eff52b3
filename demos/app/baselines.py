"""Other methods that take the steps of a scene, for comparison."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from demos.app.tables import Table, suggestion
from forms import FORMULATIONS
from solvers import STRATEGIES


@dataclass(frozen=True)
class Baseline:
    """A method to compare with.

    Attributes:
        formulation: One of `FORMULATIONS`.
        globalisation: One of `STRATEGIES`, or None for the solver's choice.
    """

    formulation: str
    globalisation: str | None = None

    def __str__(self) -> str:
        return " ".join(filter(None, (self.formulation, self.globalisation)))


def baselines(solve: Table) -> tuple[Baseline, ...]:
    """What ``baseline`` names: formulations, each with or without a globalisation.

    Raises:
        SceneError: It is something else, or there is no such method.
    """
    value = solve.value("baseline", [])
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        solve.fail(
            "baseline",
            "must be a formulation in quotes, or a list of such; a globalisation may follow, as in "
            '"displacement full-steps"',
        )
    found = []
    for text in texts:
        formulation, _, globalisation = text.partition(" ")
        _check(solve, "formulation", formulation, FORMULATIONS)
        if globalisation:
            _check(solve, "globalisation", globalisation, STRATEGIES)
        found.append(Baseline(formulation, globalisation or None))
    return tuple(dict.fromkeys(found))


def _check(solve: Table, kind: str, name: str, available: Collection[str]) -> None:
    if name not in available:
        hint = suggestion(name, available)
        solve.fail("baseline", f"unknown {kind} {name}{hint}; available: {', '.join(available)}")
