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
import ufl
from dolfinx import fem

from demos.scene import SCHEMES
from demos.studies.bar import RHO, bar
from demos.studies.study import Parameters, Record, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

END, E = 0.32, 2e4  # [s], [Pa]
QUANTITIES = ("u", "v", "energy")
ORDERS = {"backward-euler": 1}
"""Of each scheme, in every quantity."""


def grid(quick: bool) -> list[Parameters]:
    """Numbers of steps; the last is the reference."""
    counts = (16, 32, 64, 512) if quick else (16, 32, 64, 128, 256, 4096)
    return [
        {"scheme": scheme, "formulation": formulation, "steps": steps}
        for scheme in SCHEMES
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
    u, v = run.fields[0], run.scheme.v
    run.problem.refresh()
    kinetic, potential, stored = (
        float(comm.allreduce(fem.assemble_scalar(fem.form(density * ufl.dx))))
        for density in (
            run.scheme.kinetic_energy(RHO),
            run.scheme.potential_energy(RHO),
            run.psi(run.form.stretch(*run.fields)),
        )
    )
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
        "energy": [kinetic + potential + stored],
        "kinetic": kinetic,
    }


def errors(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    """Errors against the finest step, by scheme and formulation.

    Relative to the norm of the quantity, that of the total energy to the kinetic energy.
    """
    series: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        series.setdefault((r["scheme"], r["formulation"]), []).append(r)
    found = {}
    for key, (*coarse, fine) in series.items():
        found[key] = [{"h": r["h"], **_error(r, fine)} for r in coarse]
    return found


def _error(r: Record, fine: Record) -> Record:
    error = {}
    for name in QUANTITIES:
        difference = np.linalg.norm(np.subtract(r[name], fine[name]))
        scale = fine["kinetic"] if name == "energy" else np.linalg.norm(fine[name])
        error[name] = float(difference / scale)
    return error


def orders(levels: Sequence[Record]) -> dict[str, float]:
    """The order of each error, fitted over the finest three steps."""
    h = np.log([r["h"] for r in levels[-3:]])
    return {
        name: float(np.polyfit(h, np.log([r[name] for r in levels[-3:]]), 1)[0])
        for name in QUANTITIES
    }


def table(records: Sequence[Record]) -> list[str]:
    """Relative errors at the end, and orders."""
    lines = ["", f"Relative errors at t = {END} s against the finest step:", ""]
    head = "  ".join(f"{q:>9}" for q in QUANTITIES)
    lines.append(f"{'scheme':<16} {'formulation':<14} {'h [s]':>9}  {head}")
    for (scheme, formulation), levels in errors(records).items():
        for r in levels:
            shown = "  ".join(f"{r[name]:>9.2e}" for name in QUANTITIES)
            lines.append(f"{scheme:<16} {formulation:<14} {r['h']:>9.2e}  {shown}")
        found = orders(levels)
        shown = "  ".join(f"{found[name]:>9.2f}" for name in QUANTITIES)
        lines.append(f"{'':<31} {'order':>9}  {shown}")
    return lines


def verdict(records: Sequence[Record]) -> list[str]:
    """Orders more than 0.1 from what is expected, which a finite reference lifts a little."""
    return [
        f"{scheme}, {formulation}: {name} has order {found[name]:.2f}, expected {ORDERS[scheme]}"
        for (scheme, formulation), levels in errors(records).items()
        for found in [orders(levels)]
        for name in QUANTITIES
        if not abs(found[name] - ORDERS[scheme]) < 0.1
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
