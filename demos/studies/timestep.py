"""`mixed-fem study timestep`: the order of the time schemes in the step h.

A bar in 2D falls from rest under gravity for T = 0.32 s; it is so soft that the steps resolve its
vibrations. Displacement, velocity and total energy at T are compared with those of a much finer
step on the same mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.bar import bar
from demos.studies.records import Column, Record, aligned, cells, fitted_orders, groups
from demos.studies.study import Parameters, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

END, E = 0.32, 2e4  # [s], [Pa]
QUANTITIES = ("u", "v", "energy")
ORDERS = {
    "backward-euler": 1,
    "implicit-midpoint": 2,
    "bdf2": 2,
    "trapezoidal": 2,
    "generalised-alpha": 2,
}
"""Of each scheme, in every quantity."""

RESOLVED = 1e-6
"""Relative errors that are smaller on all levels are Newton's tolerance, and show no order."""


def grid(quick: bool) -> list[Parameters]:
    """Numbers of steps; the last is the reference."""
    counts = (16, 32, 64, 512) if quick else (16, 32, 64, 128, 256, 4096)
    return [
        {"scheme": scheme, "formulation": formulation, "steps": steps}
        for scheme in (["backward-euler"] if quick else ORDERS)
        for formulation in ("symmetric", "displacement")
        for steps in counts
    ]


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """March to the end. Collective."""
    steps = parameters["steps"]
    run = bar(
        comm,
        parameters["formulation"],
        scheme=parameters["scheme"],
        n=2,
        E=E,
        h=END / steps,
        dimension=2,
    )
    for _ in range(steps):
        run.step()
    u, v = run.model.u, run.scheme.v
    energies = run.model.energies(run.scheme).now()
    V = u.function_space
    owned = V.dofmap.index_map.size_local * V.dofmap.bs
    # In the order of positions, which is the same on any number of ranks.
    X = np.concatenate(comm.allgather(V.tabulate_dof_coordinates()[: owned // V.dofmap.bs]))
    order = np.lexsort(X.T)
    values = {
        name: np.concatenate(comm.allgather(f.x.array[:owned].reshape(-1, 2)))[order]
        for name, f in (("u", u), ("v", v))
    }
    return {
        "h": END / steps,
        "failure": run.failure,
        **{name: array.ravel().tolist() for name, array in values.items()},
        "energy": [sum(energies)],
        "kinetic": energies.kinetic,
    }


def errors(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    """Errors against the finest step, by scheme and formulation.

    Relative to the norm of the quantity, that of the total energy to the kinetic energy.
    """
    return {
        key: [{**r, **_error(r, fine)} for r in coarse]
        for key, (*coarse, fine) in groups(records, "scheme", "formulation").items()
    }


def _error(r: Record, fine: Record) -> Record:
    error = {}
    for name in QUANTITIES:
        difference = np.linalg.norm(np.subtract(r[name], fine[name]))
        scale = fine["kinetic"] if name == "energy" else np.linalg.norm(fine[name])
        error[name] = float(difference / scale)
    return error


def orders(levels: Sequence[Record]) -> dict[str, float]:
    """The order of each error."""
    return fitted_orders(levels, lambda r: r["h"], QUANTITIES)


COLUMNS: dict[str, Column] = {
    "scheme": "{scheme}",
    "formulation": "{formulation}",
    "h [s]": "{h:.2e}",
    **{name: f"{{{name}:.2e}}" for name in QUANTITIES},
}


def table(records: Sequence[Record]) -> list[str]:
    """Relative errors at the end, and orders."""
    rows = [list(COLUMNS)]
    for levels in errors(records).values():
        rows += [cells(r, COLUMNS) for r in levels]
        rows.append(["", "", "order", *(f"{order:.2f}" for order in orders(levels).values())])
    return ["", f"Relative errors at t = {END} s against the finest step:", "", *aligned(rows)]


def verdict(records: Sequence[Record]) -> list[str]:
    """Orders more than 0.1 from what is expected, which a finite reference lifts a little."""
    return [
        f"{scheme}, {formulation}: {name} has order {found[name]:.2f}, expected {ORDERS[scheme]}"
        for (scheme, formulation), levels in errors(records).items()
        for found in [orders(levels)]
        for name in QUANTITIES
        if not abs(found[name] - ORDERS[scheme]) < 0.1 and max(r[name] for r in levels) > RESOLVED
    ] + [f"{r['scheme']}, {r['steps']} steps: {r['failure']}" for r in records if r["failure"]]


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Errors over the step, a plot a scheme."""
    series = errors(records)
    schemes = list(dict.fromkeys(scheme for scheme, _ in series))
    figure.set_size_inches(5.0 * len(schemes), 4.0)
    plots = figure.subplots(1, len(schemes), squeeze=False, sharey=True)[0]
    for (scheme, formulation), levels in series.items():
        plot = plots[schemes.index(scheme)]
        style = "o-" if formulation == "symmetric" else "x--"
        for k, name in enumerate(QUANTITIES):
            values = [r[name] for r in levels]
            label = f"{name}, {formulation}"
            plot.loglog([r["h"] for r in levels], values, style, color=f"C{k}", label=label)
        plot.set(xlabel="h [s]", title=f"{scheme}, order {ORDERS[scheme]} expected")
        plot.grid(alpha=0.3)
        plot.legend(fontsize=7)
    plots[0].set_ylabel("relative error")


TIMESTEP = Study(
    name="timestep",
    description="order of each time scheme in h, for displacement, velocity and energy",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
