"""`mixed-fem study stiffness`: Newton iterations and success over stiffness, step and support.

Three bars, clamped, free and rotating, in a few steps each: of one material over its Young's
modulus, and of two by turns over their contrast. The displacement's Newton is the better of two,
see `demos.studies.bar.BASELINES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.bar import BASELINES, SUPPORTS, bar
from demos.studies.heat import colours, iterations
from demos.studies.records import Column, Record, crossed, groups
from demos.studies.study import Parameters, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEPS = 3
VARIANTS: dict[str, tuple[str, str | None]] = {
    "mixed": ("symmetric", None),
    **{name: ("displacement", globalisation) for name, globalisation in BASELINES.items()},
}


SOFT = 1e6
"""Young's modulus of the softer of two materials [Pa]."""

AXES = {"E": "E [Pa]", "contrast": "contrast"}


def grid(quick: bool) -> list[Parameters]:
    """Stiffnesses and steps for each support, then contrasts and steps."""
    n = 1 if quick else 3
    moduli = (1e4, 1e6, 1e8) if quick else tuple(10.0**k for k in range(3, 13))
    contrasts = (1e3, 1e9) if quick else tuple(10.0**k for k in range(10))
    steps = (0.01, 0.1) if quick else (1e-3, 1e-2, 1e-1, 1.0)
    return [
        case(support, n, h, axis, value)
        for axis, values in (("E", moduli), ("contrast", contrasts))
        for support in SUPPORTS
        for value in values
        for h in steps
    ]


def case(support: str, n: int, h: float, axis: str, value: float) -> Parameters:
    """The parameters of a case with n cells across the bar: Young's modulus or contrast `value`."""
    stiffness = {"E": SOFT, "contrast": 1.0, axis: value}
    return {"axis": axis, "support": support, **stiffness, "h": h, "cells": n}


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """March a few steps with each variant. Collective."""
    record: Record = {}
    for variant, (formulation, globalisation) in VARIANTS.items():
        run = bar(
            comm,
            formulation,
            n=parameters["cells"],
            E=parameters["E"],
            contrast=parameters["contrast"],
            h=parameters["h"],
            support=parameters["support"],
            globalisation=globalisation,
        )
        for _ in range(STEPS):
            run.step()
        taken = [result.iterations for result in run.results]
        record[variant] = float(np.mean(taken)) if not run.failure else None
        record[f"{variant}_failure"] = run.failure
        record[f"{variant}_searches"] = sum(
            "line search" in note for result in run.results for note in result.notes.values()
        )
    return record


def classical(r: Record) -> float | None:
    """Mean iterations of the better displacement variant; None if both fail."""
    found = [r[variant] for variant in BASELINES if r[variant] is not None]
    return min(found) if found else None


def _shown(taken: float | None) -> str:
    return "fails" if taken is None else f"{taken:.1f}"


def _both(r: Record) -> str:
    return f"{_shown(r['mixed'])} / {_shown(classical(r))}"


def table(records: Sequence[Record]) -> list[str]:
    """Mean Newton iterations a step, mixed / displacement; a row a stiffness or contrast."""
    lines = ["", f"Newton iterations a step, mean of {STEPS}: mixed / better displacement variant"]
    for (axis, support), rows in groups(records, "axis", "support").items():
        columns: dict[str, Column] = {AXES[axis]: f"{{{axis}:.0e}}"}
        lines += ["", support, *crossed(rows, columns, "h", "h = {h:g} s", _both)]
    mixed = sum(r["mixed"] is None for r in records)
    others = sum(classical(r) is None for r in records)
    searches = sum(r["mixed_searches"] > 0 for r in records)
    lines += [
        "",
        f"of {len(records)} cases the mixed Newton fails in {mixed}, the displacement Newton in "
        f"{others}; in {searches} the mixed one needs its line search",
    ]
    return lines


def verdict(records: Sequence[Record]) -> list[str]:
    """Cases that the displacement's Newton solves and the mixed one does not."""
    return [
        f"{r['support']}, E = {r['E']:.0e} Pa, contrast {r['contrast']:.0e}, h = {r['h']:g} s: "
        f"mixed {r['mixed_failure']}, displacement {classical(r):.1f} iterations a step"
        for r in records
        if r["mixed"] is None and classical(r) is not None
    ]


def draw(records: Sequence[Record], figure: Figure) -> None:
    """A heat map for each axis, method and support."""
    maps = groups(records, "axis", "support")
    axes, supports = (list(dict.fromkeys(key[k] for key in maps)) for k in (0, 1))
    figure.set_size_inches(4.5 * len(supports), 5.0 * len(axes))
    plots = figure.subplots(2 * len(axes), len(supports), squeeze=False)
    for (axis, support), rows in maps.items():
        row, column = 2 * axes.index(axis), supports.index(support)
        mixed, others = plots[row : row + 2, column]
        for plot, method, value in (
            (mixed, "mixed", lambda r: r["mixed"]),
            (others, "displacement", classical),
        ):
            image = iterations(plot, rows, axis, value)
            plot.set(xlabel=AXES[axis], ylabel="h [s]", title=f"{support}: {method}")
    colours(figure, image, plots)


STIFFNESS = Study(
    name="stiffness",
    description="Newton iterations and failures over E, contrast and h: clamped and thrown bars",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
