"""`mixed-fem study locking`: tip displacements against the mesh size as ν comes near 1/2.

Cook's membrane under a load so small that it is linear, against Taylor and Hood's elements on a
fine mesh, which in turn meet the published values (`demos.studies.cook`); and a cantilever of
L / t = 20 bent by P L²/(E' I) = 2 in two steps, against the elastica (`demos.studies.beams`), with
E' = E/(1 - ν²) in plane strain. Whatever the formulation, P1 displacements with a strain that is
constant on each cell lock: cells that cannot change their volume can hardly deform.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from demos.studies import cook
from demos.studies.beams import Cantilever, cantilever, elastica
from demos.studies.records import Column, Record, crossed, groups, in_columns, select
from demos.studies.study import Parameters, Study
from forms import FixedCorotational
from meshes import Body, box
from solvers import ConvergenceError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATIOS = (0.3, 0.45, 0.49, 0.499, 0.4999)
METHODS = (
    ("symmetric", "triangle", 1),
    ("displacement", "triangle", 1),
    ("symmetric", "quadrilateral", 1),
    ("mean-dilatation", "quadrilateral", 1),
    ("symmetric", "triangle", 2),
    ("mean-dilatation", "triangle", 2),
    ("symmetric", "quadrilateral", 2),
    ("mean-dilatation", "quadrilateral", 2),
    ("symmetric", "triangle", 3),
    ("mean-dilatation", "triangle", 3),
    ("taylor-hood", "triangle", 1),
)
"""Formulation, cell and degree of the element."""

QUICK_METHODS = (
    ("symmetric", "triangle", 1),
    ("symmetric", "quadrilateral", 1),
    ("mean-dilatation", "quadrilateral", 1),
    ("symmetric", "triangle", 2),
    ("mean-dilatation", "quadrilateral", 2),
)

FORCE = 1e-4  # of Cook's membrane, by E: tips move by some 1e-3 of 48
SLENDERNESS, LOADS = 20, (1.0, 2.0)  # of the beam
LEVELS = {"cook": (2, 4, 8, 16, 32, 64), "beam": (1, 2, 4, 8, 16)}
"""Cells along an edge of the membrane, and across the beam."""

QUICK_LEVELS = {"cook": (4, 8, 16), "beam": (2, 4, 8)}
CURED = tuple(method for method in METHODS if method[0] in ("mean-dilatation", "taylor-hood"))
"""Methods that ought not to lock, and how near to the reference their finest tips are."""
CURED_WITHIN = 0.05

PUBLISHED_WITHIN = 2e-3
"""Deviation of the reference of Cook's membrane from published values."""

UNITS = {"cook": "cells along an edge", "beam": "cells across"}
TITLES = {"cook": "Cook's membrane", "beam": "bent beam, P L²/(E' I) = 2"}


def grid(quick: bool) -> list[Parameters]:
    """Bodies, methods, ratios and meshes."""
    ratios = (0.3, 0.4999) if quick else RATIOS
    published = [{"body": "published", "nu": nu} for nu in cook.PUBLISHED]
    return published + [
        case(body, method, nu, n)
        for body, levels in (QUICK_LEVELS if quick else LEVELS).items()
        for method in (QUICK_METHODS if quick else METHODS)
        for nu in ratios
        for n in levels
        # Of higher degree on coarser meshes, for the same number of unknowns.
        if n * method[2] <= levels[-1]
    ]


def case(body: str, method: tuple[str, str, int], nu: float, n: int) -> Parameters:
    """The parameters of a case."""
    formulation, cell, degree = method
    return {
        **{"body": body, "formulation": formulation, "cell": cell, "degree": degree},
        **{"nu": nu, "cells": n},
    }


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Load the body, and measure how its tip has moved. Collective."""
    measure = {"published": _published, "cook": _cook, "beam": _beam}[parameters["body"]]
    return measure(comm, parameters)


def _published(comm: MPI.Comm, parameters: Parameters) -> Record:
    """The reference of Cook's membrane itself against a published value."""
    point, value = cook.PUBLISHED[parameters["nu"]]
    found = cook.reference(comm, parameters["nu"], point)
    return {"failure": "", "tip": found, "reference": value, "ratio": found / value}


def _cook(comm: MPI.Comm, parameters: Parameters) -> Record:
    panel = cook.membrane(comm, parameters["cells"], parameters["cell"])
    psi = FixedCorotational(1.0, parameters["nu"])
    body = _cantilever(panel, parameters, psi)
    body.traction.value[1] = FORCE / cook.HEIGHT
    try:
        iterations = body.problem.solve().iterations
    except ConvergenceError as error:
        return {"failure": error.result.reason}
    tip = cook.value_at(body.fields[0], cook.MIDDLE)[1] / FORCE
    return _record(iterations, tip, _reference(comm, parameters["nu"]))


def _reference(comm: MPI.Comm, nu: float) -> float:
    """That of Cook's membrane, found once for all cases with the same ratio."""
    key = comm.size, nu
    if key not in _references:
        _references[key] = cook.reference(comm, nu)
    return _references[key]


_references: dict[tuple[int, float], float] = {}


def _beam(comm: MPI.Comm, parameters: Parameters) -> Record:
    t, nu, n = 1 / SLENDERNESS, parameters["nu"], parameters["cells"]
    beam = box(comm, (1.0, t), (n * SLENDERNESS, n), parameters["cell"])
    psi = FixedCorotational(12 / t**3 * (1 - nu**2), nu)  # E' I = 1
    body = _cantilever(beam, parameters, psi)
    iterations = 0
    for load in LOADS:
        body.traction.value[1] = load / t
        try:
            iterations += body.problem.solve().iterations
        except ConvergenceError as error:
            return {"failure": error.result.reason}
    return _record(iterations, body.mean_tip()[1], elastica(LOADS[-1])[1])


def _cantilever(body: Body, parameters: Parameters, psi: FixedCorotational) -> Cantilever:
    return cantilever(body, parameters["formulation"], psi, degree=parameters["degree"])


def _record(iterations: int, tip: float, reference: float) -> Record:
    return {
        "failure": "",
        "iterations": iterations,
        "tip": tip,
        "reference": reference,
        "ratio": tip / reference,
    }


# What to show

Method = tuple[str, str, int]


def _methods(records: Sequence[Record]) -> dict[tuple[str, Method, float], list[Record]]:
    """Records of growing fineness by body, method and ratio."""
    of_bodies = [r for r in records if r["body"] != "published"]
    found = groups(of_bodies, "body", "formulation", "cell", "degree", "nu")
    return {(body, tuple(method), nu): rows for (body, *method, nu), rows in found.items()}


def _name(method: Method) -> str:
    formulation, cell, degree = method
    return f"{formulation}, {cell}, degree {degree}"


_REFERENCE: dict[str, Column] = {
    "ν": "{nu:.6g}",
    "found": "{tip:.3f}",
    "published": "{reference:.3f}",
    "deviation": lambda r: f"{r['ratio'] - 1:+.1e}",
}
_METHODS: dict[str, Column] = {"method": "{formulation}, {cell}, degree {degree}", "ν": "{nu:g}"}


def table(records: Sequence[Record]) -> list[str]:
    """Tip displacements over the reference; a row a method and ratio, a column a mesh."""
    lines = ["", "Reference of Cook's membrane, E w / F, against published values:", ""]
    lines += in_columns(select(records, body="published"), _REFERENCE)
    for body, title in TITLES.items():
        if chosen := select(records, body=body):
            lines += ["", f"{title}, tip over reference, by cells:", ""]
            lines += crossed(chosen, _METHODS, "cells", "{cells}", _ratio)
    return lines


def _ratio(r: Record) -> str:
    return "fails" if r["failure"] else f"{r['ratio']:.4f}"


def verdict(records: Sequence[Record]) -> list[str]:
    """A reference that is not what is published, mixed methods that fail, and cures that do not."""
    lines = [
        f"reference of Cook's membrane, ν = {r['nu']:g}: {r['ratio']:.4f} of what is published"
        for r in select(records, body="published")
        if not abs(r["ratio"] - 1) < PUBLISHED_WITHIN
    ]
    for (body, method, nu), rows in _methods(records).items():
        name = f"{TITLES[body]}, {_name(method)}, ν = {nu:g}"
        failed = [r for r in rows if r["failure"]]
        if method[0] != "displacement":
            lines += [f"{name}, {r['cells']} cells: {r['failure']}" for r in failed]
        if method in CURED and not failed and not abs(rows[-1]["ratio"] - 1) < CURED_WITHIN:
            lines.append(f"{name}: the finest tip is {rows[-1]['ratio']:.4f} of the reference")
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Tips over the mesh: rows of methods for each body, a line a Poisson's ratio."""
    series = _methods(records)
    bodies = list(dict.fromkeys(body for body, _, _ in series))
    methods = list(dict.fromkeys(method for _, method, _ in series))
    ratios = sorted({nu for _, _, nu in series})
    columns = min(len(methods), 5)
    rows_a_body = -(-len(methods) // columns)
    shape = rows_a_body * len(bodies), columns
    figure.set_size_inches(0.8 + 2.2 * shape[1], 2.4 * shape[0])
    plots = figure.subplots(*shape, squeeze=False, sharey=True)
    for i, body in enumerate(bodies):
        levels = sorted({r["cells"] for r in select(records, body=body)})
        here = plots[i * rows_a_body : (i + 1) * rows_a_body]
        for plot in here.ravel()[len(methods) :]:
            plot.set_visible(False)
        for row in here:
            row[0].set_ylabel(f"{TITLES[body]}\ntip / reference", fontsize=8)
        for plot, method in zip(here.ravel(), methods, strict=False):
            for k, nu in enumerate(ratios):
                done = [r for r in series.get((body, method, nu), []) if not r["failure"]]
                cells, values = ([r[name] for r in done] for name in ("cells", "ratio"))
                plot.semilogx(cells, values, "o-", ms=3, color=f"C{k}", label=f"ν = {nu:g}")
            plot.axhline(1.0, color="k", lw=0.7, ls=":")
            plot.set_xticks(levels, [str(n) for n in levels])
            plot.minorticks_off()
            plot.grid(alpha=0.3)
            plot.set_title(_name(method), fontsize=8)
            plot.set_xlabel(UNITS[body], fontsize=8)
    plots[0, 0].set_ylim(0.0, 1.2)
    plots[0, 0].legend(fontsize=6)


LOCKING = Study(
    name="locking",
    description="Cook's membrane and a bent beam against the mesh size as ν comes near 1/2",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
