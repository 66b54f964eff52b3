"""`mixed-fem study few-iterations`: how far from the step's end a few Newton iterations are.

A bar of two materials, soft and stiff by turns, falls under gravity. Every method starts every step
from the same state, that of the converged mixed method. After n iterations its displacement is
judged by two measures: the residual of the plain displacement formulation there, and the distance
to the converged positions. That a few iterations of the mixed method are enough, whatever the
contrast, is what its authors say of it (Trusty, Kaufman, Levin, 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la

from demos.studies.bar import BASELINES, RHO, Bar, bar
from demos.studies.records import Column, Record, groups, in_columns
from demos.studies.study import Parameters, Study
from forms import displacement, refresh
from solvers import ConvergenceError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

E, H, STEPS = 1e5, 0.1, 3  # of the soft material [Pa]; [s]
COUNTS = (1, 2, 3, 5)
"""Numbers of iterations after which to look."""

METHODS: dict[str, tuple[str, str | None]] = {
    "mixed": ("symmetric", None),
    "mixed, as published": ("gauss-newton", None),
    **{name: ("displacement", globalisation) for name, globalisation in BASELINES.items()},
}
"""Formulation and globalisation."""

PROMISED = 1e-3
"""Position error after 3 iterations that the mixed method keeps below."""

MEASURES = {"residual": "displacement residual", "position": "position error"}


def grid(quick: bool) -> list[Parameters]:
    """Contrasts, each by every method."""
    contrasts = (1.0, 1e3, 1e6, 1e9) if quick else tuple(10.0**k for k in range(10))
    return [
        case(method, contrast, 2 if quick else 3) for method in METHODS for contrast in contrasts
    ]


def case(method: str, contrast: float, n: int, dimension: int = 3) -> Parameters:
    """The parameters of a case with n cells across the bar."""
    return {"method": method, "contrast": contrast, "cells": n, "dimension": dimension}


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Take the steps, and look at the iterates of each; the worst step counts. Collective."""
    formulation, globalisation = METHODS[parameters["method"]]
    shape = {"n": parameters["cells"], "dimension": parameters["dimension"]}
    bars = {"E": E, "h": H, "contrast": parameters["contrast"], **shape}
    exact = bar(comm, "symmetric", **bars)
    trial = bar(
        comm, formulation, globalisation=globalisation, options={"snes_max_it": max(COUNTS)}, **bars
    )
    iterates = Iterates(trial)
    residual = DisplacementResidual(exact)
    errors: dict[str, list[list[float]]] = {name: [] for name in MEASURES}
    for _ in range(STEPS):
        for f, value in zip(trial.model.fields, exact.model.fields, strict=False):
            f.x.array[:] = value.x.array
        trial.scheme.u_old.x.array[:] = exact.scheme.u_old.x.array
        trial.scheme.v.x.array[:] = exact.scheme.v.x.array
        found = iterates.of_a_step()
        start = residual.norm(found[0])
        errors["residual"].append([residual.norm(u) / start for u in found])
        exact.step()
        u = exact.model.u.x.array
        moved = _largest(comm, u - found[0])
        errors["position"].append([_largest(comm, v - u) / moved for v in found])
        if exact.failure:
            break
    return {
        "failure": exact.failure,
        **{
            f"{name}_{n}": max(history[min(n, len(history) - 1)] for history in errors[name])
            for name in MEASURES
            for n in COUNTS
        },
    }


class Iterates:
    """The displacements that Newton's method passes through."""

    def __init__(self, run: Bar) -> None:
        self._run = run
        self._found: list[Array] = []
        run.problem.problem.solver.setMonitor(self._monitor)

    def of_a_step(self) -> list[Array]:
        """Solve, and return the displacement at the start and after each iteration. Collective."""
        self._found = []
        try:
            self._run.problem.solve()
        except ConvergenceError:
            pass  # it was not given the iterations to converge
        return self._found

    def _monitor(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        if iteration > 0 or not self._found:
            self._found.append(self._run.model.u.x.array.copy())


class DisplacementResidual:
    """The residual of a step in the displacement formulation, at any displacement."""

    def __init__(self, run: Bar) -> None:
        model = run.model
        self._u = fem.Function(model.u.function_space)
        kinetic = ufl.replace(run.scheme.kinetic(RHO), {model.u: self._u})
        energy = (displacement(self._u, model.psi) + kinetic) * ufl.dx
        for load in model.loads:
            energy += load.energy(model.body, self._u, model.rho)
        self._energy = energy
        self._form: Any = fem.form(ufl.derivative(energy, self._u))
        self._bcs = model.bcs

    def norm(self, values: Array) -> float:
        """The Euclidean norm [N] over the free vertices. Collective."""
        self._u.x.array[:] = values
        refresh([self._energy])
        b = fem.assemble_vector(self._form)
        b.scatter_reverse(la.InsertMode.add)
        for bc in self._bcs:
            dofs, _ = bc.dof_indices()
            b.array[dofs] = 0.0
        return float(la.norm(b))


def _largest(comm: MPI.Comm, values: Array) -> float:
    return float(comm.allreduce(np.abs(values).max(initial=0.0), op=MPI.MAX))


# What to show


COLUMNS: dict[str, Column] = {
    "method": "{method}",
    "contrast": "{contrast:.0e}",
    **{f"{name} {n}": f"{{{name}_{n}:.1e}}" for name in MEASURES for n in COUNTS},
}


def table(records: Sequence[Record]) -> list[str]:
    """Both measures after each number of iterations; a row a method and contrast."""
    return [
        "",
        "Relative errors of the displacement residual and of positions after so many Newton",
        f"iterations, worst of {STEPS} steps:",
        "",
        *in_columns(records, COLUMNS),
    ]


def verdict(records: Sequence[Record]) -> list[str]:
    """Contrasts at which the mixed method is not within `PROMISED` of the end in 3 iterations."""
    return [
        f"{r['method']}, contrast {r['contrast']:.0e}: a position error of {r['position_3']:.1e} "
        f"after 3 iterations, expected {PROMISED:.0e} at most"
        for r in records
        if r["method"] in ("mixed", "mixed, as published") and not r["position_3"] < PROMISED
    ]


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Both measures over the contrast, a column a method and a line a number of iterations."""
    series = groups(records, "method")
    figure.set_size_inches(2.6 * len(series), 5.0)
    plots = figure.subplots(len(MEASURES), len(series), squeeze=False, sharex=True, sharey="row")
    for column, ((method,), rows) in zip(plots.T, series.items(), strict=True):
        contrasts = [r["contrast"] for r in rows]
        for plot, name in zip(column, MEASURES, strict=True):
            for k, n in enumerate(COUNTS):
                # Rounding error is all there is below.
                values = [max(r[f"{name}_{n}"], 1e-13) for r in rows]
                label = f"{n} iteration{'s' * (n > 1)}"
                plot.loglog(contrasts, values, "o-", color=f"C{k}", markersize=3, label=label)
            plot.grid(alpha=0.3)
        column[0].set_title(method, fontsize=10)
        column[-1].set_xlabel("contrast of stiffness")
    for plot, title in zip(plots[:, 0], MEASURES.values(), strict=True):
        plot.set_ylabel(f"relative {title}")
    plots[-1, -1].legend(fontsize=7)


FEW_ITERATIONS = Study(
    name="few-iterations",
    description="error left after 1, 2, 3 and 5 Newton iterations, by contrast of two materials",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
