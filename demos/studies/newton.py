"""`mixed-fem study newton`: residuals of Newton's method on one step, formulation by formulation.

The first step of a soft bar under gravity, the same for all. Exact mixed Newton converges
quadratically from the first iterations, and linearly, by the factor shown, where the matrix is not
the derivative of the residual. The displacement's Newton first has to find its way, in two
variants: backtracking on the residual, and the projected tangent.
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


E, H = 1e5, 0.3  # [Pa], [s]
ROUND_OFF = 1e-13  # of the first residual


def grid(quick: bool) -> list[Parameters]:
    """Every formulation, and the displacement with the projected tangent too."""
    n = 2 if quick else 4
    cases = [case(formulation, n, projected=False) for formulation in FORMULATIONS]
    return [*cases, case("displacement", n, projected=True)]


def case(formulation: str, n: int, *, projected: bool, dimension: int = 3) -> Parameters:
    """The parameters of a case with n cells across the bar."""
    return {
        **{"formulation": formulation, "projected": projected},
        **{"cells": n, "dimension": dimension},
    }


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Solve one step. Collective."""
    run = bar(
        comm,
        parameters["formulation"],
        n=parameters["cells"],
        dimension=parameters["dimension"],
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
    """Order of convergence: the slope of log r over that of the iteration before.

    Of the last few residuals that are below a tenth of the first and above round-off, so that a
    linear rate may alternate.
    """
    logs = np.log([r for r in residuals if ROUND_OFF < r < 0.1][-5:])
    return float(np.polyfit(logs[:-1], logs[1:], 1)[0]) if len(logs) > 2 else float("nan")


def factor(residuals: Sequence[float]) -> float:
    """What an iteration multiplies the residual by: the mean of the last four above round-off."""
    tail = [r for r in residuals if r > ROUND_OFF][-5:]
    return float((tail[-1] / tail[0]) ** (1 / (len(tail) - 1))) if len(tail) > 1 else float("nan")


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


def verdict(records: Sequence[Record]) -> list[str]:
    """Mixed formulations that are not as fast as they should be, or faster."""
    lines = []
    for r in records:
        name = r["formulation"]
        if r["failure"]:
            lines.append(f"{_name(r)}: {r['failure']}")
        elif FORMULATIONS[name].exact and name != "displacement" and not r["order"] > 1.7:
            lines.append(f"{name}: order {r['order']:.2f}, expected 2")
        elif not FORMULATIONS[name].exact and not abs(r["order"] - 1) < 0.3:
            lines.append(f"{name}: order {r['order']:.2f}, expected 1")
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """The residuals over the iterations."""
    figure.set_size_inches(6.0, 4.0)
    plot = figure.subplots()
    for r in records:
        plot.semilogy(r["residuals"], "o-", markersize=3, label=_name(r))
    plot.set(xlabel="Newton iteration", ylabel="residual / first residual")
    plot.grid(alpha=0.3)
    plot.legend(fontsize=7)


NEWTON = Study(
    name="newton",
    description="residual histories of one step, by formulation: order and factor of convergence",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
