"""`mixed-fem study conservation`: what the time schemes keep of a spinning body.

A bar in 2D spins freely at 1 rad/s for half a turn, in steps of 0.2 s and shorter. Energy (kinetic
and elastic) and angular momentum would stay; the table shows what a scheme has lost or won of them,
relative to the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from demos.studies.bar import RHO, bar
from demos.studies.records import Column, Record, groups, in_columns
from demos.studies.study import Parameters, Study
from forms import SCHEMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TURN = math.pi  # [rad], at 1 rad/s


def grid(quick: bool) -> list[Parameters]:
    """Each scheme with inertia, of a soft and a stiff bar."""
    return [
        {"scheme": name, "E": E, "steps": steps}
        for name, scheme in SCHEMES.items()
        if scheme.inertial
        for E in ((1e5,) if quick else (1e5, 1e8))
        for steps in ((16,) if quick else (16, 32, 64, 128))
    ]


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Turn by half. Collective."""
    steps = parameters["steps"]
    run = bar(
        comm,
        "symmetric",
        scheme=parameters["scheme"],
        n=2,
        E=parameters["E"],
        h=TURN / steps,
        dimension=2,
        support="rotating",
        options={"snes_rtol": 1e-12},
    )
    v = run.scheme.v
    x = ufl.SpatialCoordinate(run.model.body.mesh) + run.scheme.u_old - ufl.as_vector((2.0, 0.5))
    momentum = fem.form(RHO * (x[0] * v[1] - x[1] * v[0]) * ufl.dx)
    energies = run.model.energies(run.scheme)

    def now() -> tuple[float, float]:
        spin = float(np.real(fem.assemble_scalar(momentum)))
        return sum(energies.now()), float(comm.allreduce(spin))

    energy, spin = now()
    for _ in range(steps):
        run.step()
    after = now()
    return {
        "h": TURN / steps,
        "energy": after[0] / energy - 1.0,
        "momentum": after[1] / spin - 1.0,
        "failure": run.failure,
    }


COLUMNS: dict[str, Column] = {
    "scheme": "{scheme}",
    "E [Pa]": "{E:.0e}",
    "h [s]": "{h:.3f}",
    "energy": "{energy:+.1e}",
    "angular momentum": "{momentum:+.1e}",
}


def table(records: Sequence[Record]) -> list[str]:
    """Relative changes over half a turn."""
    told = "Relative change over half a turn at 1 rad/s:"
    return ["", told, "", *in_columns(records, COLUMNS, case=3)]


def verdict(records: Sequence[Record]) -> list[str]:
    """Failures; and the midpoint rule where it loses angular momentum."""
    return [f"{r['scheme']}, E = {r['E']:g}: {r['failure']}" for r in records if r["failure"]] + [
        f"implicit-midpoint, E = {r['E']:g}, h = {r['h']:.3f}: angular momentum changes by "
        f"{r['momentum']:.1e}"
        for r in records
        if r["scheme"] == "implicit-midpoint" and not abs(r["momentum"]) < 1e-8
    ]


def draw(records: Sequence[Record], figure: Figure) -> None:
    """What is lost of energy over the step, a curve a scheme."""
    stiffness = sorted({r["E"] for r in records})
    figure.set_size_inches(5.0 * len(stiffness), 4.0)
    plots = figure.subplots(1, len(stiffness), squeeze=False, sharey=True)[0]
    for (E, scheme), series in groups(records, "E", "scheme").items():
        plot = plots[stiffness.index(E)]
        lost = [abs(r["energy"]) for r in series]
        plot.loglog([r["h"] for r in series], lost, "o-", label=scheme)
        plot.set(xlabel="h [s]", title=f"E = {E:.0e} Pa")
        plot.grid(alpha=0.3)
    plots[0].set_ylabel("relative change of energy in half a turn")
    plots[-1].legend(fontsize=7)


CONSERVATION = Study(
    name="conservation",
    description="energy and angular momentum that each time scheme keeps of a spinning bar",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
