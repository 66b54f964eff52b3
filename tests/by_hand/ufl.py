"""UFL's side of the comparison, assembled once; the same arrays on every rank."""

from __future__ import annotations

from functools import cache

from mpi4py import MPI

from demos.app.progress import Screen
from demos.by_hand.compare.bodies import BODIES, STATES
from demos.by_hand.compare.cases import ufl_cases
from demos.by_hand.compare.verdicts import compare, table

COMM = MPI.COMM_WORLD


@cache
def all_cases():
    """Collective at the first call."""
    return ufl_cases(COMM, Screen(COMM))


def some(formulation, body=BODIES[1], material="stable-neo-hookean", states=tuple(STATES)):
    return [
        case
        for case in all_cases()
        if case.names[:3] == (body, formulation, material) and case.names[3] in states
    ]


def failed(cases, hook=lambda system: system):
    """The rows that differ."""
    return [row for row in table(compare(cases, hook)) if not row.agrees]
