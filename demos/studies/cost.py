"""`mixed-fem study cost`: what a mixed Newton iteration and step cost, beside the classical ones.

The two formulations solve the same steps in turn, with the same mesh, material, linear solver and
tolerances, both on the engine. The displacement Newton comes in two variants, see
`demos.studies.bar.BASELINES`, and the faster one that gets through counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies import cells as engine
from demos.studies.bar import BASELINES, Bar, bar
from demos.studies.memory import forget_peak, peak_memory
from demos.studies.records import Column, Record, Remark, aligned, cells, matrix, select
from demos.studies.study import Parameters, Study
from solvers.options import CONDENSED_CG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIANTS = ("mixed", *BASELINES)
PHASES = ("residual", "jacobian", "condensation", "setup", "solve")

# A bar of 4 m × 1 m × 1 m: cells across, 24 n³ tetrahedra.
SIZES = {8: 10, 12: 6, 16: 4, 26: 3, 35: 3}  # and steps
ONE_CLASSICAL_STEP_FROM = 26  # cells across: it has some thirty iterations, for which one waits
QUICK_SIZES = {8: 10, 12: 6, 16: 4}
BOTH_MATERIALS_AT = 16

ITERATION = 1.15  # of a mixed iteration by a displacement iteration, on that mesh
LOCAL = 1e-6  # [s], of work in a cell on one core
GROWTH = 1.3  # of the cost of a mixed iteration per tetrahedron
MANY, FASTER = 8, 3.0  # displacement iterations a step, and how many times faster mixed is there
SLOWER = 1.2  # where the displacement takes fewer


def grid(quick: bool) -> list[Parameters]:
    """Meshes at one stiffness and step, then stiffnesses and steps on one mesh."""
    cases: list[Parameters] = []
    for n, steps in (QUICK_SIZES if quick else SIZES).items():
        materials = ["stable-neo-hookean"]
        if n == BOTH_MATERIALS_AT:
            materials.append("as-rigid-as-possible")
        cases += [_case("mesh", n, m, 1e7, 0.1, steps) for m in materials]
    n, steps = (4, 3) if quick else (8, 5)
    cases += [
        _case("grid", n, "stable-neo-hookean", E, h, steps)
        for E in (1e4, 1e5, 1e6, 1e7, 1e8, 1e9)
        for h in (0.01, 0.1, 1.0)
    ]
    return cases + engine.grid(quick)


def _case(kind: str, n: int, material: str, E: float, h: float, steps: int) -> Parameters:
    names = ("kind", "tetrahedra", "n", "material", "E", "h", "steps")
    return dict(zip(names, (kind, 24 * n**3, n, material, E, h, steps), strict=True))


def _build(comm: MPI.Comm, variant: str, case: Parameters) -> Bar:
    # The same solver on every mesh, that its growth may be seen.
    always_cg = {f"condensed_{key}": value for key, value in CONDENSED_CG.items()}
    return bar(
        comm,
        "symmetric" if variant == "mixed" else "displacement",
        **{name: case[name] for name in ("n", "E", "h", "material")},
        globalisation=BASELINES.get(variant),
        options=always_cg if case["kind"] == "mesh" else None,
    )


def _record(comm: MPI.Comm, run: Bar) -> Record:
    """Of the steps that succeeded, with medians over them; the slowest rank counts."""
    r = run.results[:-1] if run.failure else run.results
    values: Record = {
        "failure": run.failure,
        "steps_done": len(r),
        "iterations": [result.iterations for result in r],
        "krylov": [result.krylov_iterations for result in r],
        "seconds": [comm.allreduce(result.timings["total"], op=MPI.MAX) for result in r],
    }
    for phase in PHASES:
        each = [result.timings[phase] / result.iterations for result in r if result.iterations]
        values[phase] = comm.allreduce(_median(each), op=MPI.MAX)
    return values


def compute(comm: MPI.Comm, case: Parameters) -> Record:
    """Run the variants in turn, step by step, or what the engine measures. Collective."""
    if case["kind"] not in ("mesh", "grid"):
        return engine.compute(comm, case)
    variants = VARIANTS if case["kind"] == "grid" else VARIANTS[:2]
    for variant in variants:  # what is compiled or loaded once is not to be timed
        if (variant, case["kind"], case["material"]) not in _loaded:
            _build(comm, variant, {**case, "n": 1, "E": 1e7, "h": 0.1}).step()
            _loaded.add((variant, case["kind"], case["material"]))
    forget_peak()
    runs = {variant: _build(comm, variant, case) for variant in variants}
    for step in range(case["steps"]):
        for variant, run in runs.items():
            if variant == "mixed" or step == 0 or case["n"] < ONE_CLASSICAL_STEP_FROM:
                comm.barrier()
                run.step()
    record: Record = {}
    for variant, run in runs.items():
        record |= {f"{variant}_{name}": value for name, value in _record(comm, run).items()}
    if case["kind"] == "mesh":
        record["peak_memory"] = comm.allreduce(peak_memory())
        for variant, run in runs.items():
            work = sum(engine.local_work(run.problem).values())
            record[f"{variant}_local"] = comm.allreduce(work, op=MPI.MAX)
    return record


_loaded: set[tuple[str, str, str]] = set()


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


# What to show


def _per_iteration(record: Record, variant: str) -> float:
    """Median over the steps of the seconds of an iteration."""
    seconds, iterations = record[f"{variant}_seconds"], record[f"{variant}_iterations"]
    return _median([s / n for s, n in zip(seconds, iterations, strict=True) if n])


def _per_step(record: Record, variant: str) -> float:
    """Mean seconds of the steps that all that got through took; infinite for one that failed."""
    if record[f"{variant}_failure"]:
        return float("inf")
    steps = min(record[f"{v}_steps_done"] for v in VARIANTS if record.get(f"{v}_failure") == "")
    return float(np.mean(record[f"{variant}_seconds"][:steps]))


def classical(record: Record) -> str:
    """The faster of the displacement's variants that got through."""
    return min(VARIANTS[1:], key=lambda variant: _per_step(record, variant))


def _ratio(record: Record) -> float:
    """Seconds of a mixed iteration over those of a displacement iteration."""
    return _per_iteration(record, "mixed") / _per_iteration(record, "displacement")


def _faster(record: Record) -> float:
    """How many times faster the mixed Newton gets through the steps than the displacement's."""
    return _per_step(record, classical(record)) / _per_step(record, "mixed")


def table(records: Sequence[Record]) -> list[str]:
    """An iteration and a step on each mesh, then iterations and seconds over the grid."""
    rows = [list(_MESH)]
    for r in select(records, kind="mesh"):
        rows += [cells(_phases(r, variant), _MESH) for variant in VARIANTS[:2]]
        step = _per_step(r, "displacement") / _per_step(r, "mixed")
        ratios = f"mixed / displacement: an iteration {_ratio(r):.2f}, a step 1/{step:.1f}"
        rows.append(["", Remark(ratios)])
    if found := _growth(records):
        first, last, (mixed, classic, krylov) = found
        times = f"mixed {mixed:.2f}, displacement {classic:.2f}, CG its {krylov:.2f} times"
        ends = f"from {first['tetrahedra']} to {last['tetrahedra']}"
        rows.append(["", Remark(f"{ends}, a tetrahedron: {times}")])
    return [
        "",
        "Milliseconds of a Newton iteration, medians over steps with E = 1e7 Pa, h = 0.1 s, by CG",
        "with GAMG. 'local': per-cell work, µs a tetrahedron; 'assembly': residual and matrix,",
        "that included; 'GB': peak memory, both together.",
        "",
        *aligned(rows),
        "",
        "Newton iterations and seconds a step, mixed against the better displacement variant",
        "(d: full steps, a search where they fail; o: the tangent projected on demand), and",
        "how many times faster:",
        "",
        *aligned([list(_GRID), *(cells(r, _GRID) for r in select(records, kind="grid"))]),
        *engine.table(records),
    ]


def _growth(records: Sequence[Record]) -> tuple[Record, Record, list[float]] | None:
    """How an iteration's cost per tetrahedron grows from 40k tetrahedra to the finest mesh.

    Returns:
        Both ends, and what the cost of the mixed iteration, that of the displacement's and the
        number of linear iterations are multiplied by; None without two meshes.
    """
    rows = [
        r
        for r in select(records, kind="mesh", material="stable-neo-hookean")
        if r["tetrahedra"] > 4e4
    ]
    if len(rows) < 2:
        return None
    first, last = (choose(rows, key=lambda r: r["tetrahedra"]) for choose in (min, max))
    tetrahedra = last["tetrahedra"] / first["tetrahedra"]
    times = [_per_iteration(last, v) / _per_iteration(first, v) / tetrahedra for v in VARIANTS[:2]]
    return first, last, [*times, _krylov(last, "mixed") / _krylov(first, "mixed")]


def _krylov(record: Record, variant: str) -> float:
    """Linear iterations of a Newton iteration."""
    return sum(record[f"{variant}_krylov"]) / max(sum(record[f"{variant}_iterations"]), 1)


def _phases(r: Record, variant: str) -> Record:
    """What the table of meshes shows of a variant; milliseconds of a Newton iteration."""
    phase = {name: 1e3 * r[f"{variant}_{name}"] for name in PHASES}
    return {
        "tetrahedra": r["tetrahedra"],
        "material": r["material"],
        "newton": "mixed" if variant == "mixed" else "displacement",
        "local": 1e6 * r[f"{variant}_local"],
        "assembly": phase["residual"] + phase["jacobian"],
        **phase,
        "total": 1e3 * _per_iteration(r, variant),
        "krylov": _krylov(r, variant),
        "iterations": _median(r[f"{variant}_iterations"]),
        "step": _per_step(r, variant),
        "memory": r["peak_memory"],
    }


_MESH: dict[str, Column] = {
    "tetrahedra": "{tetrahedra}",
    "material": "{material}",
    "Newton": "{newton}",
    "local": "{local:.2f}",
    "assembly": "{assembly:.0f}",
    "condense": "{condensation:.0f}",
    "set-up": "{setup:.0f}",
    "CG": "{solve:.0f}",
    "total": "{total:.0f}",
    "CG its": "{krylov:.1f}",
    "its/step": "{iterations:.0f}",
    "s/step": "{step:.2f}",
    "GB": "{memory:.1f}",
}


def _iterations_and_seconds(r: Record, variant: str) -> str:
    if r[f"{variant}_failure"]:
        return f"fails at step {r[f'{variant}_steps_done'] + 1}"
    return f"{np.mean(r[f'{variant}_iterations']):.1f} its {_per_step(r, variant):.3f} s"


_GRID: dict[str, Column] = {
    "E [Pa]": "{E:.0e}",
    "h [s]": "{h:g}",
    "mixed": lambda r: _iterations_and_seconds(r, "mixed"),
    "displacement": lambda r: f"{_iterations_and_seconds(r, best := classical(r))} {best[0]}",
    "faster": lambda r: f"{_faster(r):.1f}",
}


def verdict(records: Sequence[Record]) -> list[str]:
    """Failures of the mixed Newton alone, and costs above what is claimed."""
    lines, many = [], []
    for r in select(records, kind="mesh"):
        where = f"{r['tetrahedra']} tetrahedra, {r['material']}"
        if r["n"] == BOTH_MATERIALS_AT and not _ratio(r) <= ITERATION:
            lines.append(
                f"{where}: a mixed iteration costs {_ratio(r):.2f} displacement iterations, more "
                f"than {ITERATION:g}"
            )
        if r["mixed_local"] > LOCAL:
            lines.append(f"{where}: {1e6 * r['mixed_local']:.2f} µs a cell, more than 1")
    if (found := _growth(records)) and found[2][0] > GROWTH:
        first, last, (mixed, _, _) = found
        lines.append(
            f"cost of a mixed iteration per tetrahedron: {mixed:.2f} times from "
            f"{first['tetrahedra']} to {last['tetrahedra']}, more than {GROWTH:g}"
        )
    for r in select(records, kind="grid"):
        best, where = classical(r), f"E = {r['E']:.0e} Pa, h = {r['h']:g} s"
        if r[f"{best}_failure"]:
            continue
        if r["mixed_failure"]:
            lines.append(f"{where}: mixed {r['mixed_failure']}, displacement gets through")
        elif np.mean(r[f"{best}_iterations"]) >= MANY:
            many.append(_faster(r))
        elif not _faster(r) >= 1 / SLOWER:
            lines.append(f"{where}: a step {1 / _faster(r):.2f} times slower, more than {SLOWER:g}")
    if many and not _median(many) >= FASTER:
        lines.append(
            f"where the displacement takes {MANY} iterations or more: {_median(many):.1f} "
            f"times faster in the median, not {FASTER:g}"
        )
    return lines + engine.verdict(records)


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Seconds a step over the mesh, and the speed-up over the grid."""
    figure.set_size_inches(9.0, 3.8)
    left, right = figure.subplots(1, 2)
    meshes = select(records, kind="mesh", material="stable-neo-hookean")
    for variant, name in (("mixed", "mixed"), ("displacement", "displacement")):
        seconds = [_per_step(r, variant) for r in meshes]
        left.loglog([r["tetrahedra"] for r in meshes], seconds, "o-", label=name)
    left.set(xlabel="tetrahedra", ylabel="seconds a step", title="E = 1e7 Pa, h = 0.1 s")
    left.legend()
    h, E, faster = matrix(select(records, kind="grid"), "h", "E", _faster)
    image = right.imshow(np.log10(faster), cmap="RdBu", vmin=-1.5, vmax=1.5, aspect="auto")
    for (i, j), ratio in np.ndenumerate(faster):
        right.text(j, i, f"{ratio:.1f}", ha="center", va="center")
    right.set_xticks(range(len(E)), [f"{value:.0e}" for value in E])
    right.set_yticks(range(len(h)), [f"{value:g}" for value in h])
    right.set(xlabel="E [Pa]", ylabel="h [s]", title="mixed Newton: times faster a step")
    figure.colorbar(image, ax=right, label="log10")


COST = Study(
    name="cost",
    description="seconds of a mixed Newton iteration and step beside the displacement Newton's",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
