"""`mixed-fem study newton`: residuals of Newton's method on one step, formulation by formulation.

The first step of a soft bar under gravity, the same for all. Exact mixed
Newton converges quadratically from the first iterations; the displacement's Newton first has to
find its way, in two variants: backtracking on the residual, and the projected tangent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.bar import bar
from demos.studies.study import Parameters, Record, Study
from forms import FORMULATIONS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


E, H = 1e6, 0.3  # [Pa], [s]


def grid(quick: bool) -> list[Parameters]:
    """Every formulation, and the displacement with the projected tangent too."""
    n = 2 if quick else 4
    cases = [case(formulation, n, projected=False) for formulation in FORMULATIONS]
    return [*cases, case("displacement", n, projected=True)]


def case(formulation: str, n: int, *, projected: bool) -> Parameters:
    """The parameters of a case with n cells across the bar."""
    return {"formulation": formulation, "projected": projected, "cells": n}


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Solve one step. Collective."""
    run = bar(
        comm,
        parameters["formulation"],
        n=parameters["cells"],
        E=E,
        h=H,
        compiled=parameters["projected"],
        projected=parameters["projected"],
    )
    run.step()
    (result,) = run.results
    residuals = [r / result.residuals[0] for r in result.residuals]
    return {
        "failure": run.failure,
        "iterations": result.iterations,
        "order": order(residuals),
        "factor": factor(residuals),
        "residuals": residuals,
    }


def order(residuals: Sequence[float]) -> float:
    """Order of convergence from the last three residuals above round-off."""
    r = _tail(residuals)
    return float(np.log(r[-1] / r[-2]) / np.log(r[-2] / r[-3])) if len(r) >= 3 else float("nan")


def factor(residuals: Sequence[float]) -> float:
    """What the last iteration above round-off multiplies the residual by."""
    r = _tail(residuals)
    return r[-1] / r[-2] if len(r) >= 2 else float("nan")


def _tail(residuals: Sequence[float]) -> list[float]:
    return [r for r in residuals if r > 1e-12]


def _name(r: Record) -> str:
    return r["formulation"] + (" (projected)" if r["projected"] else "")


def table(records: Sequence[Record]) -> list[str]:
    """Iterations, order, factor and the residuals themselves."""
    lines = [
        "",
        f"{'formulation':<24} {'iterations':>10} {'order':>6} {'factor':>8}  relative residuals",
    ]
    for r in records:
        shown = " ".join(f"{value:.0e}" for value in r["residuals"][-6:])
        cut = "... " if len(r["residuals"]) > 6 else ""
        count = f"fails ({r['iterations']})" if r["failure"] else str(r["iterations"])
        lines.append(
            f"{_name(r):<24} {count:>10} {r['order']:>6.2f} {r['factor']:>8.0e}  {cut}{shown}"
        )
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """The residuals over the iterations."""
    figure.set_size_inches(6.0, 4.0)
    plot = figure.subplots()
    for r in records:
        plot.semilogy(r["residuals"], "o-", markersize=3, label=_name(r))
    plot.set(xlabel="Newton iteration", ylabel="residual / first residual")
    plot.legend(fontsize=7)


NEWTON = Study(
    name="newton",
    description="residual histories of one step, by formulation: order and factor of convergence",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
)
