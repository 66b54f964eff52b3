"""`mixed-fem study stiffness`: Newton iterations and success over stiffness, step and support.

Three bars, clamped, free and rotating, in a few steps each. The displacement's Newton is the better
of two: backtracking on the residual, and the projected tangent with Armijo's condition.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.bar import SUPPORTS, bar
from demos.studies.study import Parameters, Record, Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEPS = 3
VARIANTS = {
    "mixed": ("symmetric", False),
    "backtracking": ("displacement", False),
    "projected": ("displacement", True),
}


def grid(quick: bool) -> list[Parameters]:
    """Stiffnesses and steps for each support."""
    n = 1 if quick else 3
    moduli = (1e4, 1e6, 1e8) if quick else tuple(10.0**k for k in range(3, 13))
    steps = (0.01, 0.1) if quick else (1e-3, 1e-2, 1e-1, 1.0)
    return [
        {"support": support, "E": E, "h": h, "cells": n}
        for support in SUPPORTS
        for E in moduli
        for h in steps
    ]


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """March a few steps with each variant. Collective."""
    record: Record = {}
    for variant, (formulation, projected) in VARIANTS.items():
        run = bar(
            comm,
            formulation,
            n=parameters["cells"],
            E=parameters["E"],
            h=parameters["h"],
            support=parameters["support"],
            projected=projected,
        )
        for _ in range(STEPS):
            run.step()
        iterations = [result.iterations for result in run.results]
        record[variant] = float(np.mean(iterations)) if not run.failure else None
        record[f"{variant}_failure"] = run.failure
        record[f"{variant}_searches"] = sum(
            "line search" in note for result in run.results for note in result.notes.values()
        )
    return record


def classical(r: Record) -> float | None:
    """Mean iterations of the better displacement variant; None if both fail."""
    found = [r[variant] for variant in ("backtracking", "projected") if r[variant] is not None]
    return min(found) if found else None


def _shown(iterations: float | None) -> str:
    return "fails" if iterations is None else f"{iterations:.1f}"


def table(records: Sequence[Record]) -> list[str]:
    """Mean Newton iterations a step, mixed / displacement; a row a stiffness."""
    lines = ["", f"Newton iterations a step, mean of {STEPS}: mixed / better displacement variant"]
    steps = sorted({r["h"] for r in records})
    for support in dict.fromkeys(r["support"] for r in records):
        lines += ["", f"{support:<9} E [Pa]" + "".join(f"{f'h = {h:g} s':>16}" for h in steps)]
        rows = [r for r in records if r["support"] == support]
        for E in sorted({r["E"] for r in rows}):
            cells = {
                r["h"]: f"{_shown(r['mixed'])} / {_shown(classical(r))}"
                for r in rows
                if r["E"] == E
            }
            lines.append(f"{E:>16.0e}" + "".join(f"{cells[h]:>16}" for h in steps))
    mixed = sum(r["mixed"] is None for r in records)
    others = sum(classical(r) is None for r in records)
    searches = sum(r["mixed_searches"] > 0 for r in records)
    lines += [
        "",
        f"of {len(records)} cases the mixed Newton fails in {mixed}, the displacement Newton in "
        f"{others}; in {searches} the mixed one needs its line search",
    ]
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """A heat map for each support and method."""
    figure.set_size_inches(10.0, 6.0)
    supports = list(dict.fromkeys(r["support"] for r in records))
    plots = figure.subplots(2, len(supports), squeeze=False)
    for column, support in zip(plots.T, supports, strict=True):
        rows = [r for r in records if r["support"] == support]
        _heat(column[0], f"{support}, mixed", rows, [r["mixed"] for r in rows])
        _heat(column[1], f"{support}, displacement", rows, [classical(r) for r in rows])


def _heat(plot: Axes, title: str, rows: Sequence[Record], values: Sequence[float | None]) -> None:
    E, h = (sorted({r[name] for r in rows}) for name in ("E", "h"))
    image = np.full((len(h), len(E)), np.nan)
    for r, value in zip(rows, values, strict=True):
        i, j = h.index(r["h"]), E.index(r["E"])
        image[i, j] = np.nan if value is None else value
        plot.text(j, i, _shown(value), ha="center", va="center", fontsize=7)
    plot.imshow(
        np.log(image), cmap="viridis_r", vmin=0.0, vmax=np.log(50.0), aspect="auto", alpha=0.7
    )
    plot.set_xticks(range(len(E)), [f"{value:.0e}" for value in E], fontsize=6)
    plot.set_yticks(range(len(h)), [f"{value:g}" for value in h])
    plot.set(xlabel="E [Pa]", ylabel="h [s]", title=title)


STIFFNESS = Study(
    name="stiffness",
    description="Newton iterations and failures over E and h, clamped, free and rotating bars",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
)
