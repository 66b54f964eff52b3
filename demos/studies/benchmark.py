"""`mixed-fem study benchmark`: beams as plane bodies against published values, mesh by mesh.

Statics: a cantilever under a dead force at its tip, loaded in steps up to P L²/(E I) = 10, against
the elastica, whose tip displacements Mattiasson (1981) tabulates. Dynamics: the first natural
frequency of a cantilever that is let go, against the beams of Bernoulli and of Timoshenko. Backward
Euler turns the mode of frequency ω into powers of z with 1 - 1/z = ± i ω h, so that ω follows from
the recurrence of the tip's positions without any error in time.

Poisson's ratio is 0 and Ψ quadratic in S - I, so that E is the modulus of the beam and its moment
is linear in its curvature. The elastica has no thickness, extension or shear: with L / t = 50 these
are worth some 0.6 (t/L)² = 2e-4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.beams import (
    CLAMPED_FREE,
    MATTIASSON,
    cantilever,
    elastica,
    timoshenko_frequency,
)
from demos.studies.records import Column, Record, aligned, cells, groups, select
from demos.studies.study import Parameters, Study
from forms import Corotational
from meshes import Body, box
from solvers import ConvergenceError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LENGTH, RHO = 1.0, 1.0  # [m], [kg/m³]
LOADS = tuple(float(k) for k in range(1, 11))  # P L²/(E I)
SLENDERNESS = {"elastica": 50, "vibration": 20}  # L / t
TIP = 1e-3  # of the length, at the start of the vibration: small against nonlinearity
PERIOD_STEPS, STEPS, SKIPPED = 40, 60, 25  # higher modes die in the steps that are skipped

WITHIN = {"elastica": 2e-3, "vibration": 2e-3}
"""Relative deviation from the reference that the extrapolated values keep below."""


def grid(quick: bool) -> list[Parameters]:
    """Both benchmarks on meshes of growing fineness, and the displacement method beside."""
    levels = (1, 2, 4, 8) if quick else (1, 2, 4, 8, 16)
    cases = [case(kind, "symmetric", n) for kind in SLENDERNESS for n in levels]
    return cases + [case(kind, "displacement", n) for kind in SLENDERNESS for n in levels[:3]]


def case(kind: str, formulation: str, n: int) -> Parameters:
    """The parameters of a case with n squares of two triangles each across the beam."""
    return {"kind": kind, "formulation": formulation, "cells": n}


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Load the beam, or let it swing. Collective."""
    kind, n = parameters["kind"], parameters["cells"]
    t = LENGTH / SLENDERNESS[kind]
    body = box(comm, (LENGTH, t), (n * SLENDERNESS[kind], n))
    psi = Corotational(E=12 / t**3, nu=0.0)  # E I = 1 N m
    measure = {"elastica": _elastica, "vibration": _vibration}[kind]
    return measure(body, parameters["formulation"], psi, t)


def _elastica(body: Body, formulation: str, psi: Corotational, t: float) -> Record:
    beam = cantilever(body, formulation, psi)
    iterations, tips = [], []
    for load in LOADS:
        beam.traction.value[1] = load / t
        try:
            iterations.append(beam.problem.solve().iterations)
        except ConvergenceError as error:
            return {"failure": f"{error.result.reason} at P L²/(E I) = {load:g}"}
        tips.append(beam.mean_tip())
    references = [elastica(load) for load in LOADS]
    return {
        "failure": "",
        "iterations": iterations,
        "u": [-tip[0] / LENGTH for tip in tips],
        "w": [tip[1] / LENGTH for tip in tips],
        "u_elastica": [u for u, _ in references],
        "w_elastica": [w for _, w in references],
        "deviation": tips[-1][1] / LENGTH / references[-1][1] - 1,
    }


def _vibration(body: Body, formulation: str, psi: Corotational, t: float) -> Record:
    unit = 1 / np.sqrt(RHO * t) / LENGTH**2  # [1/s] for E I = 1
    h = 2 * np.pi / (CLAMPED_FREE**2 * unit) / PERIOD_STEPS
    # A step of so many periods is a static solution.
    beam = cantilever(body, formulation, psi, rho=RHO, h=1e6 * h)
    beam.traction.value[1] = 3 * TIP * LENGTH / t
    try:
        beam.problem.solve()
        beam.scheme.advance()
        beam.scheme.v.x.array[:] = 0.0
        beam.scheme.h.value = h
        beam.traction.value[:] = 0.0
        tips = []
        for _ in range(STEPS):
            beam.problem.solve()
            beam.scheme.advance()
            tips.append(beam.mean_tip()[1])
    except ConvergenceError as error:
        return {"failure": error.result.reason}
    frequency = frequency_of_backward_euler(tips[SKIPPED:], h) / unit
    reference = timoshenko_frequency(SLENDERNESS["vibration"])
    return {
        "failure": "",
        "frequency": frequency,
        "timoshenko": reference,
        "bernoulli": CLAMPED_FREE**2,
        "deviation": float(frequency / reference - 1),
    }


def frequency_of_backward_euler(positions: Sequence[float], h: float) -> float:
    """Angular frequency [1/s] of a linear oscillator from its positions by backward Euler.

    They are a sum of powers of z and its conjugate, the roots of z² = a z + b; a and b are fitted.
    """
    y = np.asarray(positions)
    (a, b), *_ = np.linalg.lstsq(np.column_stack([y[1:-1], y[:-2]]), y[2:])
    z = np.roots([1.0, -a, -b])[0]
    return float(abs(np.imag(1 / z)) / h)


# What to show


def extrapolated(coarse: float, fine: float) -> float:
    """The limit of values with an error that a halved mesh size divides by four."""
    return fine + (fine - coarse) / 3


def limit(levels: Sequence[Record]) -> Record:
    """What the finest two levels are extrapolated to, and its deviation from the reference."""
    coarse, fine = levels[-2:]
    if fine["kind"] == "vibration":
        frequency = extrapolated(coarse["frequency"], fine["frequency"])
        return {"frequency": frequency, "deviation": frequency / fine["timoshenko"] - 1}
    tips = {
        name: [extrapolated(a, b) for a, b in zip(coarse[name], fine[name], strict=True)]
        for name in ("u", "w")
    }
    return {**tips, "deviation": tips["w"][-1] / fine["w_elastica"][-1] - 1}


_TIPS = {f"u/L, w/L at {load:g}": LOADS.index(load) for load in MATTIASSON}
_STATIC: dict[str, Column] = {
    "formulation": "{formulation}",
    "cells": "{cells}",
    **{heading: f"{{u[{k}]:.5f}}, {{w[{k}]:.5f}}" for heading, k in _TIPS.items()},
    "deviation": "{deviation:+.4f}",
    "iterations": lambda r: str(sum(r["iterations"]) or ""),
}
_DYNAMIC: dict[str, Column] = {
    "formulation": "{formulation}",
    "cells": "{cells}",
    "frequency": "{frequency:.4f}",
    "deviation": "{deviation:+.4f}",
}


def table(records: Sequence[Record]) -> list[str]:
    """Tip displacements at the loads of Mattiasson's table, frequencies, deviations by level."""
    static, dynamic = [list(_STATIC)], [list(_DYNAMIC)]
    for (kind, _), levels in groups(records, "kind", "formulation").items():
        rows, columns = (static, _STATIC) if kind == "elastica" else (dynamic, _DYNAMIC)
        rows += [cells(r, columns, case=2) for r in levels]
        if len(levels) > 1 and not any(r["failure"] for r in levels[-2:]):
            last = {"formulation": "", "cells": "limit", "iterations": [], **limit(levels)}
            rows.append(cells(last, columns))
    published = [f"{u:.5f}, {w:.5f}" for u, w in MATTIASSON.values()]
    static.append(["Mattiasson (1981)", "", *published, "", ""])
    return [
        "",
        "Cantilever under a tip load, L / t = 50; deviation of w at P L²/(E I) = 10:",
        "",
        *aligned(static),
        "",
        "First frequency of a cantilever in √(EI/ρA)/L², L / t = 20:",
        "",
        *aligned(dynamic),
        f"Timoshenko: {timoshenko_frequency(SLENDERNESS['vibration']):.4f}, "
        f"Bernoulli: {CLAMPED_FREE**2:.4f}",
    ]


def verdict(records: Sequence[Record]) -> list[str]:
    """Mixed values that fail, or whose limit is not where the reference is."""
    lines = []
    for (kind,), levels in groups(select(records, formulation="symmetric"), "kind").items():
        failed = [r for r in levels if r["failure"]]
        lines += [f"{kind}, {r['cells']} cells across: {r['failure']}" for r in failed]
        if failed or len(levels) < 2:
            continue
        deviation, within = limit(levels)["deviation"], WITHIN[kind]
        if not abs(deviation) < within:
            lines.append(f"{kind}: the limit is {deviation:+.1e} off, more than {within:g}")
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Tip displacements over the load, and deviations over the number of cells."""
    figure.set_size_inches(9.0, 3.8)
    left, right = figure.subplots(1, 2)
    dense = np.linspace(0.05, LOADS[-1], 100)
    for k, name in enumerate(("u / L", "w / L")):
        left.plot(dense, [elastica(load)[k] for load in dense], "k-", lw=1, label="elastica" * k)
        values = [tips[k] for tips in MATTIASSON.values()]
        left.plot(list(MATTIASSON), values, "kx", ms=7, label="Mattiasson (1981)" * k)
        left.annotate(
            name, (LOADS[-2], elastica(LOADS[-2])[k]), (0, -16), textcoords="offset points"
        )
    across = sorted({r["cells"] for r in records})
    for r in select(records, kind="elastica", failure=""):
        color = f"C{across.index(r['cells'])}"
        left.plot(LOADS, r["w"], "o", ms=3, color=color, label=f"w, {r['cells']} across")
        left.plot(LOADS, r["u"], "s", ms=3, mfc="none", color=color)
    left.set(xlabel="P L² / (E I)", ylabel="tip displacement / L", title="cantilever, tip load")
    left.legend(fontsize=7)
    names = {"elastica": "w of the elastica", "vibration": "first frequency"}
    done = groups(select(records, failure=""), "kind", "formulation")
    for (kind, formulation), levels in done.items():
        deviations = [abs(r["deviation"]) for r in levels]
        style = "o-" if formulation == "symmetric" else "x--"
        label = f"{names[kind]}, {formulation}"
        right.loglog([r["cells"] for r in levels], deviations, style, ms=4, label=label)
    right.set_xticks(across, [str(n) for n in across])
    right.minorticks_off()
    right.set(xlabel="cells across the beam", ylabel="relative deviation", title="by refinement")
    right.legend(fontsize=7)
    right.grid(alpha=0.3)


BENCHMARK = Study(
    name="benchmark",
    description="a large-deflection and a vibrating beam against published values, by refinement",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
