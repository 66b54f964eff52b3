"""`mixed-fem plot`: energies and their balance, iterations, residuals and reactions of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from demos.viewing.results import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ENERGIES = {"kinetic_energy": "kinetic", "elastic_energy": "elastic", "potential_energy": "loads"}
_WORKS = {
    "work_of_loads": "work of loads",
    "work_of_motions": "work of motions",
    "dissipated_energy": "dissipated",
    "missing_energy": "missing",
}


def plot(results: Results) -> Figure:
    """Four panels over time: energies and works [J], Newton iterations, residuals, reactions [N].

    Args:
        results: Of a run.

    Raises:
        ResultsError: Its tables cannot be read.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    energies, iterations, residuals, reactions = figure.subplots(2, 2).ravel()
    _energies(energies, results)
    _iterations(iterations, results)
    _residuals(residuals, results)
    _reactions(reactions, results)
    figure.suptitle(f"{results.name}, {results.about.get('formulation', '')}")
    return figure


def _energies(axes: Axes, results: Results) -> None:
    history = results.history
    for name, label in _ENERGIES.items():
        axes.plot(history["time"], history[name], label=label)
    for name, label in _WORKS.items():
        if name in history and np.abs(history[name]).max() > 0.0:
            axes.plot(history["time"], history[name], "--", label=label)
    axes.set(title="energies and their balance", xlabel="t [s]", ylabel="J")
    axes.legend(fontsize="small")


def _iterations(axes: Axes, results: Results) -> None:
    from matplotlib.ticker import MaxNLocator

    history = results.history
    axes.bar(history["step"], history["newton_iterations"], color="#44648c")
    axes.set(title="Newton iterations", xlabel="step")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


def _residuals(axes: Axes, results: Results) -> None:
    steps = results.newton.groupby("step")
    for k, (_, rows) in enumerate(steps):
        shade = 0.25 + 0.75 * (k + 1) / len(steps)
        axes.semilogy(rows["iteration"], rows["residual"], "o-", ms=3, color="#44648c", alpha=shade)
    axes.set(title="residual of each step (later ones darker)", xlabel="Newton iteration")


def _reactions(axes: Axes, results: Results) -> None:
    history = results.history
    names = [name for name in history if name.startswith("reaction_")]
    for name in names:
        _, boundary, axis = name.split("_")
        axes.plot(history["time"], history[name], label=f"boundary {boundary}, {axis}")
    axes.set(title="reactions", xlabel="t [s]", ylabel="N")
    if names:
        axes.legend(fontsize="small")
    else:
        axes.text(0.5, 0.5, "nothing is held", ha="center", transform=axes.transAxes)
