"""`mixed-fem study endurance`: what is left behind by a thousand steps, and a thousand problems.

In a process of its own memory, open files and PETSc options are counted after a first tenth, and at
the end. `UCX_MEM_EVENTS=no`, as UCX (below MPICH in the wheels) else remembers each piece of memory
that any library gives back to the system: about 50 kB a problem.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from demos.studies.ranks import RanksError, on_ranks
from demos.studies.records import Column, Record, in_columns
from demos.studies.study import Parameters, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 0.01
"""By which part memory may grow."""

PROGRAM = """
import gc, json, os, sys
from mpi4py import MPI
from petsc4py import PETSc
from demos.studies.bar import bar
from demos.studies.memory import release, resident_memory

kind, solver, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
comm = MPI.COMM_WORLD

def made():
    return bar(comm, "symmetric", n=2, E=1e6, h=0.05, dimension=2, solver=solver)

one = made() if kind == "steps" else None
found = []
for k in range(1, count + 1):
    run = made() if one is None else one
    run.step()
    if run.failure:
        raise RuntimeError(run.failure)
    run.results.clear()
    del run
    if k in (count // 10, count):
        release(comm)
        files = len(os.listdir("/proc/self/fd"))
        mine = comm.allreduce(resident_memory())
        found.append([mine, files, len(PETSc.Options().getAll())])
if comm.rank == 0:
    print(json.dumps(found))
"""


def grid(quick: bool) -> list[Parameters]:
    """Steps of one problem, and problems of a step each, made and dropped."""
    count = 100 if quick else 1000
    return [
        {"kind": kind, "solver": solver, "ranks": ranks, "count": count}
        for ranks in ((1,) if quick else (1, 2))
        for solver in (("condensed",) if quick else ("condensed", "fieldsplit", "direct"))
        for kind in ("steps", "problems")
    ]


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Count in another process."""
    arguments = (parameters["kind"], parameters["solver"], str(parameters["count"]))
    before = os.environ.get("UCX_MEM_EVENTS")
    os.environ["UCX_MEM_EVENTS"] = "no"
    try:
        told = on_ranks(parameters["ranks"], PROGRAM, *arguments, timeout=1800.0)
    except RanksError as error:
        return {"failure": str(error)}
    finally:
        os.environ.pop("UCX_MEM_EVENTS")
        if before is not None:
            os.environ["UCX_MEM_EVENTS"] = before
    first, last = json.loads(told.strip().splitlines()[-1])
    return {
        "memory": last[0],
        "growth": last[0] / first[0] - 1.0,
        "files": last[1] - first[1],
        "options": last[2] - first[2],
        "failure": "",
    }


COLUMNS: dict[str, Column] = {
    "ranks": "{ranks}",
    "solver": "{solver}",
    "what": "{count} {kind}",
    "memory [GB]": "{memory:.3f}",
    "growth": "{growth:+.2%}",
    "files": "{files:+d}",
    "options": "{options:+d}",
}


def table(records: Sequence[Record]) -> list[str]:
    """What has come in addition since the first tenth."""
    return ["", "Left behind since the first tenth:", "", *in_columns(records, COLUMNS, case=3)]


def verdict(records: Sequence[Record]) -> list[str]:
    """What grows."""
    lines = []
    for r in records:
        what = f"{r['count']} {r['kind']}, {r['solver']}, {r['ranks']} ranks"
        if r["failure"]:
            lines.append(f"{what}: {r['failure']}")
        elif r["growth"] > MOST or r["files"] > 0 or r["options"] > 0:
            lines.append(
                f"{what}: memory {r['growth']:+.2%}, {r['files']} files, {r['options']} options"
            )
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """How memory has grown."""
    done = [r for r in records if not r["failure"]]
    figure.set_size_inches(6.0, 0.4 * len(done) + 1.5)
    plot = figure.subplots()
    labels = [f"{r['count']} {r['kind']}, {r['solver']}, {r['ranks']} ranks" for r in done]
    plot.barh(labels, [100 * r["growth"] for r in done])
    plot.axvline(100 * MOST, color="k", lw=0.8)
    plot.set(xlabel="growth of memory since the first tenth [%]")
    plot.invert_yaxis()


ENDURANCE = Study(
    name="endurance",
    description="memory, files and options after a thousand steps, and a thousand problems",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
    starts_ranks=True,
)
