"""`mixed-fem study newton`: residuals of Newton's method on one step, formulation by formulation.

The first step of a soft bar under gravity, the same for all. Exact mixed Newton converges
quadratically from the first iterations, and linearly, by the factor shown, where the matrix is not
the derivative of the residual. The displacement's Newton first has to find its way, in two
variants, see `demos.studies.bar.BASELINES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from demos.studies.bar import BASELINES, bar
from demos.studies.records import Column, Record, in_columns, power
from demos.studies.study import Parameters, Study
from forms import FORMULATIONS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


E, H = 2e4, 0.3  # [Pa], [s]
ROUND_OFF = 1e-12  # of the first residual


def grid(quick: bool) -> list[Parameters]:
    """Every formulation, and the displacement in its other variant too."""
    n = 2 if quick else 4
    # `taylor-hood` gets to round-off before its order shows.
    names = [name for name in FORMULATIONS if name != "taylor-hood"]
    cases = [case(formulation, n, globalisation=None) for formulation in names]
    return [*cases, case("displacement", n, globalisation=BASELINES["on demand"])]


def case(formulation: str, n: int, *, globalisation: str | None, dimension: int = 3) -> Parameters:
    """The parameters of a case with n cells across the bar."""
    return {
        **{"formulation": formulation, "globalisation": globalisation},
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
        globalisation=parameters["globalisation"],
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

    Of the last few residuals that are below the first and above round-off, so that a linear rate
    may alternate.
    """
    tail = [r for r in residuals if ROUND_OFF < r < 1.0][-5:]
    return power(tail[:-1], tail[1:])


def factor(residuals: Sequence[float]) -> float:
    """What an iteration multiplies the residual by: the mean of the last four above round-off."""
    tail = [r for r in residuals if r > ROUND_OFF][-5:]
    return float((tail[-1] / tail[0]) ** (1 / (len(tail) - 1))) if len(tail) > 1 else float("nan")


def _name(r: Record) -> str:
    return r["formulation"] + (f" ({r['globalisation']})" if r["globalisation"] else "")


def _residuals(r: Record) -> str:
    shown = " ".join(f"{value:.0e}" for value in r["residuals"][-6:])
    return f"... {shown}" if len(r["residuals"]) > 6 else shown


COLUMNS: dict[str, Column] = {
    "formulation": _name,
    "iterations": lambda r: f"{r['iterations']}{' (fails)' * bool(r['failure'])}",
    "order": "{order:.2f}",
    "factor": "{factor:.0e}",
    "relative residuals": _residuals,
}


def table(records: Sequence[Record]) -> list[str]:
    """Iterations, order, factor and the residuals themselves."""
    return ["", *in_columns(records, COLUMNS)]


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
