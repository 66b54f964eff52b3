"""`mixed-fem study duel`: the mixed Newton against the displacement's at its best, cell by cell.

Bars, clamped, thrown and spinning, over stiffness, time step and contrast of two materials. All
methods take their steps in turns, in one process, on one mesh, with one linear solver (that of
`solver="condensed"` for its size) and one rule for when a step is done. A method that
takes too many iterations, or many times as long as the mixed one, is stopped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

from demos.studies import duel_results
from demos.studies.bar import Bar, bar, mesh_of_bar
from demos.studies.records import Record
from demos.studies.study import Parameters, Study
from meshes import Body
from solvers.lifetime import weakly
from solvers.strategies import STRATEGIES

MIXED = "mixed"
METHODS: dict[str, tuple[str, str]] = {
    MIXED: ("symmetric", next(iter(STRATEGIES))),
    **{name: ("displacement", name) for name in STRATEGIES},
}
"""Formulation and globalisation of each; the displacement's by the name of the latter."""

STEPS = 3
MOST = 100
"""Iterations that a step may take."""

SLOWER, LEAST, LONGEST = 5.0, 3.0, 60.0
"""A method may take so many times as long as the mixed one, but at least so many seconds; the mixed
one so many seconds. Seconds are those at 12,288 tetrahedra; they grow and fall with their number,
though not below a fifth."""

CLOSE, REPEATS = 1.5, 3
"""Where times are closer than this, mixed and the fastest other are timed so many times more."""

SUPPORTS = {"clamped": "clamped", "thrown": "free", "spinning": "rotating"}
"""Those of `bar`."""

HANGING = ("clamped", 1e7, 0.1, 1.0)
SPINNING = ("spinning", 1e9, 1.0, 1.0)
STIFF = ("spinning", 1e12, 0.1, 1.0)
LARGE: tuple[tuple[str, float, float, float], ...] = (HANGING, SPINNING, STIFF)
"""Support, E, h and contrast of the cases on a fine mesh."""

MATERIALS = ("as-rigid-as-possible", "fixed-corotational", "mooney-rivlin")

COARSE, USUAL, FINE = 4, 8, 16
"""Cells across the bar."""


def grid(quick: bool) -> list[Parameters]:
    """The grid, other materials on a coarser mesh, and the hardest cases on a finer one."""
    moduli = (1e5, 1e9) if quick else (1e3, 1e5, 1e7, 1e9, 1e12)
    steps = (0.1, 1.0) if quick else (0.01, 0.1, 1.0)
    contrasts = (1.0, 1e6) if quick else (1.0, 1e3, 1e6)
    cases = [
        case(support, E, h, contrast, COARSE if quick else USUAL)
        for contrast in contrasts
        for support in SUPPORTS
        for E in moduli
        for h in steps
    ]
    for material in MATERIALS:
        coarse = ((1e5, 0.1),) if quick else ((1e5, 0.1), (1e5, 1.0), (1e9, 0.1), (1e9, 1.0))
        for support in SUPPORTS:
            cases += [case(support, E, h, 1.0, COARSE, material) for E, h in coarse]
    fine = [case(*HANGING, USUAL)] if quick else [case(*c, FINE) for c in LARGE]
    return cases + fine


def case(
    support: str,
    E: float,
    h: float,
    contrast: float,
    n: int,
    material: str = "stable-neo-hookean",
    dimension: int = 3,
) -> Parameters:
    """The parameters of a case with n cells across the bar; E [Pa] of the softer material."""
    name = f"{support} E={E:.0e} h={h:g} contrast={contrast:.0e}"
    return {
        "case": name + (f" {material}" if material != "stable-neo-hookean" else ""),
        **{"support": support, "E": E, "h": h, "contrast": contrast, "cells": n},
        **{"material": material, "dimension": dimension},
        "tetrahedra": 4 * n**dimension * (6 if dimension == 3 else 2),
    }


def compute(comm: MPI.Comm, parameters: Parameters) -> list[Record]:
    """Let all methods take their steps, in turns; a record each. Collective."""
    body = mesh_of_bar(comm, parameters["cells"], parameters["dimension"])
    size = max(parameters["tetrahedra"] / 12288, 0.2)
    contenders = {name: Contender(comm, name, parameters, body) for name in METHODS}
    mixed = contenders[MIXED]
    for _ in range(STEPS):
        for one in contenders.values():
            allowed = LONGEST if one is mixed else max(LEAST, SLOWER * mixed.seconds / size)
            one.step(allowed * size)
    close = _close(contenders)
    for _ in range(REPEATS if close else 0):
        for one in close:
            one.again()
    return [one.record(mixed) for one in contenders.values()]


def _close(contenders: Mapping[str, Contender]) -> list[Contender]:
    """The mixed method and the fastest other, if their times are much the same."""
    mixed, *others = contenders.values()
    done = [one for one in others if not one.failure]
    if mixed.failure or not done:
        return []
    fastest = min(done, key=lambda one: one.seconds)
    ratio = max(fastest.seconds, mixed.seconds) / min(fastest.seconds, mixed.seconds)
    return (
        [mixed, fastest] if mixed.run.model.u.function_space.mesh.comm.bcast(ratio < CLOSE) else []
    )


class Contender:
    """A method on its way.

    Attributes:
        run: Its bar.
        seconds: Wall time of its steps; the least, if they were taken again.
        failure: Why it has failed or was stopped, or nothing.
    """

    def __init__(self, comm: MPI.Comm, name: str, parameters: Parameters, body: Body) -> None:
        """Build the bar. Collective."""
        formulation, globalisation = METHODS[name]
        self.run: Bar = bar(
            comm,
            formulation,
            n=parameters["cells"],
            E=parameters["E"],
            h=parameters["h"],
            contrast=parameters["contrast"],
            material=parameters["material"],
            dimension=parameters["dimension"],
            support=SUPPORTS[parameters["support"]],
            options={"snes_max_it": MOST},
            body=body,
            globalisation=globalisation,
        )
        self.name, self.failure = name, ""
        self.seconds = 0.0
        self._comm = comm
        self._start = [values.copy() for values in self._state()]
        self._stopped = ""
        self._deadline, self._allowed, self._iterations = np.inf, np.inf, 0
        self.run.problem.problem.solver.setMonitor(weakly(self._watch))

    def step(self, allowed: float) -> None:
        """Take a step, unless one has failed. Collective.

        Args:
            allowed: Seconds that all steps may have taken at its end.
        """
        if self.failure:
            return
        start = time.perf_counter()
        self._allowed, self._deadline = allowed, start + allowed - self.seconds
        self._iterations, self._stopped = 0, ""
        self.run.step()
        self.seconds += self._comm.bcast(time.perf_counter() - start)
        if self.run.failure:
            why = self._stopped or self.run.failure
            self.failure = f"step {len(self.run.results)}: {why}"

    def again(self) -> None:
        """Take all steps once more from the start, and keep the lesser time. Collective."""
        for values, first in zip(self._state(), self._start, strict=True):
            values[:] = first
        self.run.scheme.t = 0.0
        before, self.seconds = self.seconds, 0.0
        results = list(self.run.results)
        for _ in range(STEPS):
            self.step(np.inf)
        self.run.results[:] = results
        self.seconds = min(before, self.seconds)

    def record(self, mixed: Contender) -> Record:
        """What came of it. Collective."""
        results = self.run.results
        apart = None
        if not (self.failure or mixed.failure):
            difference = np.abs(self.run.model.u.x.array - mixed.run.model.u.x.array)
            apart = float(self._comm.allreduce(difference.max(initial=0.0), op=MPI.MAX))
        notes = [note for result in results for note in result.notes.values()]
        return {
            "method": self.name,
            "iterations": [result.iterations for result in results],
            "krylov": sum(result.krylov_iterations for result in results),
            "seconds": self.seconds,
            "failed": self.failure,
            "apart": apart,
            "notes": {note: notes.count(note) for note in notes},
        }

    def _state(self) -> list[npt.NDArray[np.float64]]:
        scheme = self.run.scheme
        return [f.x.array for f in (*self.run.model.fields, scheme.u_old, scheme.v)]

    def _watch(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        """Stop what takes too long. Called by PETSc after each iteration."""
        self._iterations += iteration > 0
        if self._iterations > MOST:
            self._stopped = f"stopped after {MOST} iterations"
        elif self._comm.bcast(time.perf_counter() > self._deadline):
            self._stopped = f"stopped after {self._allowed:.1f} s"
        if self._stopped and not snes.getConvergedReason() > 0:
            snes.setConvergedReason(PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_COUNT)


DUEL = Study(
    name="duel",
    description="the mixed Newton beside the best displacement Newton, over stiffness and step",
    grid=grid,
    compute=compute,
    table=duel_results.table,
    draw=duel_results.draw,
    verdict=duel_results.verdict,
)
