"""`mixed-fem study stiffness`: Newton iterations and success over stiffness, step and support.

Three bars, clamped, free and rotating, in a few steps each: of one material over its Young's
modulus, and of two by turns over their contrast. The displacement's Newton is the better of two:
backtracking on the residual, and the projected tangent with Armijo's condition.
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
    from matplotlib.image import AxesImage

STEPS = 3
VARIANTS = {
    "mixed": ("symmetric", False),
    "backtracking": ("displacement", False),
    "projected": ("displacement", True),
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
    for variant, (formulation, projected) in VARIANTS.items():
        run = bar(
            comm,
            formulation,
            n=parameters["cells"],
            E=parameters["E"],
            contrast=parameters["contrast"],
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


def _by_axis_and_support(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    maps: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        maps.setdefault((r["axis"], r["support"]), []).append(r)
    return maps


def table(records: Sequence[Record]) -> list[str]:
    """Mean Newton iterations a step, mixed / displacement; a row a stiffness or contrast."""
    lines = ["", f"Newton iterations a step, mean of {STEPS}: mixed / better displacement variant"]
    steps = sorted({r["h"] for r in records})
    for (axis, support), rows in _by_axis_and_support(records).items():
        head = "".join(f"{f'h = {h:g} s':>16}" for h in steps)
        lines += ["", f"{support:<9} {AXES[axis]:<10}{head}"]
        for value in sorted({r[axis] for r in rows}):
            cells = {
                r["h"]: f"{_shown(r['mixed'])} / {_shown(classical(r))}"
                for r in rows
                if r[axis] == value
            }
            lines.append(f"{value:>16.0e}    " + "".join(f"{cells.get(h, ''):>16}" for h in steps))
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
    maps = _by_axis_and_support(records)
    axes, supports = (list(dict.fromkeys(key[k] for key in maps)) for k in (0, 1))
    figure.set_size_inches(4.5 * len(supports), 5.0 * len(axes))
    plots = figure.subplots(2 * len(axes), len(supports), squeeze=False)
    for (axis, support), rows in maps.items():
        row, column = 2 * axes.index(axis), supports.index(support)
        mixed, others = plots[row : row + 2, column]
        _heat(mixed, f"{support}: mixed", axis, rows, [r["mixed"] for r in rows])
        image = _heat(others, f"{support}: displacement", axis, rows, [classical(r) for r in rows])
    bar = figure.colorbar(image, ax=plots, shrink=0.4, label="Newton iterations a step")
    bar.set_ticks([1, 3, 10, 30, 100], labels=["1", "3", "10", "30", "100"])


def _heat(
    plot: Axes, title: str, axis: str, rows: Sequence[Record], values: Sequence[float | None]
) -> AxesImage:
    """Iterations by step and stiffness; what fails is left white."""
    stiffness, h = (sorted({r[name] for r in rows}) for name in (axis, "h"))
    picture = np.full((len(h), len(stiffness)), np.nan)
    for r, value in zip(rows, values, strict=True):
        i, j = h.index(r["h"]), stiffness.index(r[axis])
        picture[i, j] = np.nan if value is None else value
        plot.text(j, i, _shown(value), ha="center", va="center", fontsize=7)
    image = plot.imshow(
        picture, cmap="viridis_r", norm="log", vmin=1.0, vmax=100.0, aspect="auto", alpha=0.7
    )
    plot.set_xticks(range(len(stiffness)), [f"{value:.0e}" for value in stiffness], fontsize=6)
    plot.set_yticks(range(len(h)), [f"{value:g}" for value in h])
    plot.set(xlabel=AXES[axis], ylabel="h [s]", title=title)
    return image


STIFFNESS = Study(
    name="stiffness",
    description="Newton iterations and failures over E, contrast and h: clamped and thrown bars",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
