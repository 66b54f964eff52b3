"""`mixed-fem study scaling`: the same mesh on more ranks, and meshes that grow with the ranks.

A bar of 4 m × 1 m × 1 m, clamped at x = 0, begins to fall. The first step finds out where entries
of matrices go and is not timed; those after it are. The study itself runs in serial and starts each
case with `mpiexec` as processes of their own.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from demos.studies.bar import bar
from demos.studies.memory import forget_peak, peak_memory, release, resident_memory
from demos.studies.ranks import RanksError, on_ranks
from demos.studies.records import Column, Record, groups, in_columns, select
from demos.studies.study import Parameters, Study
from solvers.options import CONDENSED_CG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

E, H = 1e7, 0.1  # [Pa], [s]
STEPS = 4  # that are timed
TIMEOUT = 600.0  # [s], of a case

SOLVERS = ("condensed", "fieldsplit")
PHASES = ("residual", "jacobian", "condensation", "setup", "solve")

# Cells across the bar; 24 n³ tetrahedra.
STRONG, QUICK_STRONG = 16, 8
WEAK, QUICK_WEAK = 10, 5  # on a rank

TWICE = {"fieldsplit": 1.6, "condensed": 1.7}
"""How many times faster two ranks are to be on the finest mesh."""


def rank_counts() -> tuple[int, ...]:
    """1, 2, 4, ... as far as there are cores, and 2 in any case."""
    counts = [1, 2]
    while 2 * counts[-1] <= _cores():
        counts.append(2 * counts[-1])
    return tuple(counts)


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def grid(quick: bool) -> list[Parameters]:
    """Strong and weak scaling with each solver."""
    strong, weak = (QUICK_STRONG, QUICK_WEAK) if quick else (STRONG, WEAK)
    return [
        case(kind, solver, n, ranks)
        for kind, n in (("strong", strong), ("weak", weak))
        for solver in SOLVERS
        for ranks in rank_counts()
    ]


def case(kind: str, solver: str, n: int, ranks: int) -> Parameters:
    """The parameters of a case with n cells across the bar on one rank."""
    across = n if kind == "strong" else round(n * ranks ** (1 / 3))
    return {
        **{"kind": kind, "solver": solver, "ranks": ranks},
        **{"tetrahedra": 24 * across**3, "n": across, "cores": _cores()},
    }


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Measure on as many ranks as the case has."""
    code = f"from {__name__} import {worker.__name__}; worker()"
    try:
        out = on_ranks(parameters["ranks"], code, json.dumps(parameters), timeout=TIMEOUT)
    except RanksError as error:
        return {"failure": str(error)}
    record: Record = json.loads(out.splitlines()[-1])
    return record


def worker() -> None:
    """Measure the case on the command line, and print the record."""
    comm = MPI.COMM_WORLD
    try:
        record = measure(comm, json.loads(sys.argv[1]))
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        comm.Abort(1)
        raise
    if comm.rank == 0:
        print(json.dumps(record), flush=True)


def measure(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Take a step, and time those after it. Collective.

    Seconds are those of the slowest rank, a Newton iteration; memory is that of all ranks [GB].
    """
    solver = parameters["solver"]
    options = {f"condensed_{key}": value for key, value in CONDENSED_CG.items()}
    choices: dict[str, Any] = {"options": options}
    if solver == "fieldsplit":
        choices = {"preconditioner": "schur-full-gmres"}
    small = bar(comm, "symmetric", n=1, E=E, h=H, solver=solver, **choices)
    small.step()  # what is compiled or loaded once is not to be timed
    del small
    release(comm)
    forget_peak()
    before = resident_memory()
    run = bar(comm, "symmetric", n=parameters["n"], E=E, h=H, solver=solver, **choices)
    for _ in range(1 + STEPS):
        comm.barrier()
        run.step()
    results = run.results[1:]
    newton = sum(result.iterations for result in results)
    krylov = sum(sum(result.krylov) for result in results)
    record: Record = {
        "failure": run.failure,
        "newton": newton,
        "krylov": krylov / max(newton, 1),
    }
    for phase in (*PHASES, "total"):
        seconds = sum(result.timings.get(phase, 0.0) for result in results)
        record[phase] = comm.allreduce(seconds, op=MPI.MAX) / max(newton, 1)
    record["memory"] = comm.allreduce(peak_memory() - before)
    return record


def gains(records: Sequence[Record]) -> list[float]:
    """For each record how many times more tetrahedra a second than on one rank; nan if unknown.

    Of a Newton iteration, so that their number does not matter.
    """

    def rate(r: Record) -> float:
        return float("nan") if r["failure"] else r["tetrahedra"] / r["total"]

    one = {(r["kind"], r["solver"]): rate(r) for r in records if r["ranks"] == 1}
    return [rate(r) / one.get((r["kind"], r["solver"]), float("nan")) for r in records]


def table(records: Sequence[Record]) -> list[str]:
    """A row a case."""
    lines = [
        "",
        f"'Newton': iterations of {STEPS} steps, and then seconds of one on the slowest rank.",
        "'faster': tetrahedra a second beside one rank's; 'eff.': that by rank; 'MB/rank': peak",
        "memory of a rank, without libraries.",
        "condensed: the engine, CG with GAMG; fieldsplit: assembled by DOLFINx, schur-full-gmres. "
        f"{_cores()} cores here.",
    ]
    rows = [{**r, "gain": gain} for r, gain in zip(records, gains(records), strict=True)]
    for (kind, solver), chosen in groups(rows, "kind", "solver").items():
        lines += ["", f"{kind} scaling, {solver}", *in_columns(chosen, COLUMNS, case=2)]
    if any(r["ranks"] > r["cores"] for r in records):
        lines += ["", "*: more ranks than cores"]
    return lines


COLUMNS: dict[str, Column] = {
    "ranks": lambda r: f"{r['ranks']}{'*' * (r['ranks'] > r['cores'])}",
    "tetrahedra": "{tetrahedra}",
    "Newton": "{newton}",
    "Krylov": "{krylov:.1f}",
    "assembly": lambda r: f"{r['residual'] + r['jacobian']:.3f}",
    "eliminate": "{condensation:.3f}",
    "set-up": "{setup:.3f}",
    "solve": "{solve:.3f}",
    "total": "{total:.3f}",
    "faster": "{gain:.2f}",
    "eff.": lambda r: f"{r['gain'] / r['ranks']:.2f}",
    "MB/rank": lambda r: f"{1e3 * r['memory'] / r['ranks']:.0f}",
}


def verdict(records: Sequence[Record]) -> list[str]:
    """Failures, other Newton iterations on more ranks, and too little gain of two ranks."""
    lines = []
    strong = select(records, kind="strong", failure="")
    for r, gain in zip(records, gains(records), strict=True):
        where = f"{r['kind']} scaling, {r['solver']}, {r['ranks']} ranks"
        if r["failure"]:
            lines.append(f"{where}: {r['failure']}")
            continue
        if r["kind"] != "strong":
            continue
        one = select(strong, ranks=1, solver=r["solver"])
        if one and one[0]["newton"] != r["newton"]:
            lines.append(f"{where}: {r['newton']} Newton iterations, {one[0]['newton']} on one")
        wanted = TWICE[r["solver"]]
        if r["ranks"] == 2 <= r["cores"] and r["n"] >= STRONG and gain < wanted:
            lines.append(f"{where}: {gain:.2f} times faster than one, not {wanted:g}")
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Speed-up and efficiency over the ranks."""
    figure.set_size_inches(8.0, 3.6)
    left, right = figure.subplots(1, 2)
    rows = [(r, gain) for r, gain in zip(records, gains(records), strict=True) if not r["failure"]]
    for solver in SOLVERS:
        strong, weak = (
            [(r["ranks"], gain) for r, gain in rows if (r["kind"], r["solver"]) == (kind, solver)]
            for kind in ("strong", "weak")
        )
        left.plot([p for p, _ in strong], [gain for _, gain in strong], "o-", label=solver)
        right.plot([p for p, _ in weak], [gain / p for p, gain in weak], "o-", label=solver)
    most = max((r["ranks"] for r, _ in rows), default=1)
    left.plot([1, most], [1, most], "k:", linewidth=0.8)
    left.set(xlabel="ranks", ylabel="times faster", title="strong scaling")
    right.set(xlabel="ranks", ylabel="efficiency", title="weak scaling", ylim=(0.0, 1.2))
    left.legend()


SCALING = Study(
    name="scaling",
    description="strong and weak scaling over ranks, which it starts by itself",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
    starts_ranks=True,
)
