"""Cases of a study, computed and shown."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from types import ModuleType

from mpi4py import MPI

from demos.studies import Record, Study
from demos.studies.records import of_case


def computed(study: ModuleType, cases: Sequence[Record]) -> list[Record]:
    """The records of some cases. Collective."""
    return [r for case in cases for r in of_case(case, study.compute(MPI.COMM_WORLD, case))]


def show(study: Study, records: list[Record]) -> None:
    """Make the table of a study, and its figure where there is matplotlib; rank 0 as in a run."""
    if MPI.COMM_WORLD.rank > 0:
        return
    assert len(study.table(records)) > len(records) // 2
    if importlib.util.find_spec("matplotlib"):
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        study.draw(records, figure)
        figure.draw_without_rendering()
