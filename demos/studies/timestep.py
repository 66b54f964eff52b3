"""`mixed-fem study timestep`: the order of the time schemes in the step h.

A soft bar in 2D falls from rest under gravity for T = 0.32 s. Displacement, velocity and total
energy at T are compared with those of a much finer step on the same mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from demos.studies.bar import RHO, bar
from demos.studies.study import Parameters, Record, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

END, E = 0.32, 1e6  # [s], [Pa]
QUANTITIES = ("u", "v", "energy")
ORDER = 1
"""Of backward Euler, in every quantity."""


def grid(quick: bool) -> list[Parameters]:
    """Numbers of steps; the last is the reference."""
    counts = (16, 32, 64, 512) if quick else (16, 32, 64, 128, 256, 4096)
    return [
        {"formulation": formulation, "steps": steps}
        for formulation in ("symmetric", "displacement")
        for steps in counts
    ]


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """March to the end. Collective."""
    steps = parameters["steps"]
    run = bar(comm, parameters["formulation"], n=2, E=E, h=END / steps, dimension=2)
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


def errors(records: Sequence[Record]) -> list[Record]:
    """Errors of each formulation and quantity against the finest step.

    Relative to the norm of the quantity, that of the total energy to the kinetic energy.
    """
    found = []
    for formulation in dict.fromkeys(r["formulation"] for r in records):
        *coarse, fine = (r for r in records if r["formulation"] == formulation)
        for r in coarse:
            error: Record = {"formulation": formulation, "h": r["h"], "failure": r["failure"]}
            for name in QUANTITIES:
                difference = np.linalg.norm(np.subtract(r[name], fine[name]))
                scale = fine["kinetic"] if name == "energy" else np.linalg.norm(fine[name])
                error[name] = float(difference / scale)
            found.append(error)
    return found


def orders(levels: Sequence[Record]) -> dict[str, float]:
    """The order of each error, fitted over the finest three steps."""
    h = np.log([r["h"] for r in levels[-3:]])
    return {
        name: float(np.polyfit(h, np.log([r[name] for r in levels[-3:]]), 1)[0])
        for name in QUANTITIES
    }


def _by_formulation(records: Sequence[Record]) -> dict[str, list[Record]]:
    series: dict[str, list[Record]] = {}
    for error in errors(records):
        series.setdefault(error["formulation"], []).append(error)
    return series


def table(records: Sequence[Record]) -> list[str]:
    """Relative errors at the end, and orders."""
    lines = ["", f"Backward Euler, relative errors at t = {END} s against the finest step:", ""]
    lines.append(f"{'formulation':<14} {'h [s]':>9}  " + "  ".join(f"{q:>9}" for q in QUANTITIES))
    for formulation, levels in _by_formulation(records).items():
        for r in levels:
            shown = "  ".join(f"{r[name]:>9.2e}" for name in QUANTITIES)
            lines.append(f"{formulation:<14} {r['h']:>9.2e}  {shown}")
        found = orders(levels)
        shown = "  ".join(f"{found[name]:>9.2f}" for name in QUANTITIES)
        lines.append(f"{'':<14} {'order':>9}  {shown}")
    return lines


def verdict(records: Sequence[Record]) -> list[str]:
    """Orders more than 0.15 from what is expected, which a finite reference lifts a little."""
    return [
        f"{formulation}: {name} has order {found[name]:.2f}, expected {ORDER}"
        for formulation, levels in _by_formulation(records).items()
        for found in [orders(levels)]
        for name in QUANTITIES
        if not abs(found[name] - ORDER) < 0.15
    ]


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Errors over the step."""
    figure.set_size_inches(5.0, 4.0)
    plot = figure.subplots()
    for levels, style in zip(_by_formulation(records).values(), ("o-", "x--"), strict=False):
        for k, name in enumerate(QUANTITIES):
            label = f"{name}, {levels[0]['formulation']}"
            values = [r[name] for r in levels]
            plot.loglog([r["h"] for r in levels], values, style, color=f"C{k}", label=label)
    plot.set(xlabel="h [s]", ylabel="relative error", title="backward Euler")
    plot.legend(fontsize=7)


TIMESTEP = Study(
    name="timestep",
    description="order of the time scheme in h, for displacement, velocity and energy",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
