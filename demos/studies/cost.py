"""`mixed-fem study cost`: what a mixed Newton iteration and step cost, beside the classical ones.

The two formulations solve the same steps in turn, with the same mesh, material, linear solver and
tolerances, both with compiled kernels. The displacement Newton comes in two variants, and the
faster one that gets through counts: PETSc's backtracking on the residual, and the positive
semi-definite projected tangent with Armijo's condition on the energy.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from demos.studies.bar import Bar, bar
from demos.studies.memory import forget_peak, peak_memory
from demos.studies.study import Parameters, Record, Study
from solvers.options import CONDENSED_CG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIANTS = ("mixed", "backtracking", "projected")
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
    return cases


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
        projected=variant == "projected",
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
    """Run the variants in turn, step by step. Collective."""
    variants = VARIANTS if case["kind"] == "grid" else VARIANTS[:2]
    for variant in variants:  # what is compiled or loaded once is not to be timed
        _build(comm, variant, {**case, "n": 1, "E": 1e7, "h": 0.1}).step()
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
            record[f"{variant}_local"] = comm.allreduce(_local_work(run), op=MPI.MAX)
    return record


def _local_work(run: Bar) -> float:
    """Seconds a cell on this rank: matrix, residual, elimination and recovery by the kernels.

    Each time at another displacement, so that the kinematics count once.
    """
    kernel, arrays = run.kernel, [np.zeros_like(f.x.array) for f in run.fields]
    u = run.fields[0].x.array
    mesh = run.fields[0].function_space.mesh
    blocks = np.zeros((len(kernel.couplings), mesh.geometry.dim, mesh.geometry.dim))
    times = []
    for _ in range(6):
        u *= 1.0 + 1e-12
        start = time.perf_counter()
        kernel.residual(*arrays)
        kernel.matrix(blocks)
        if len(arrays) > 1:
            kernel.eliminate(arrays[1], arrays[2], arrays[0])
            kernel.recover(*arrays, *arrays[1:])
        times.append(time.perf_counter() - start)
    # The first compiles, or loads what is not in memory.
    return _median(times[1:]) / mesh.topology.index_map(mesh.topology.dim).size_local


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
    return _per_iteration(record, "mixed") / _per_iteration(record, "backtracking")


def _faster(record: Record) -> float:
    """How many times faster the mixed Newton gets through the steps than the displacement's."""
    return _per_step(record, classical(record)) / _per_step(record, "mixed")


def table(records: Sequence[Record]) -> list[str]:
    """An iteration and a step on each mesh, then iterations and seconds over the grid."""
    lines = [
        "",
        "Milliseconds of a Newton iteration, medians over steps with E = 1e7 Pa, h = 0.1 s, by CG",
        "with GAMG. 'local': per-cell work, µs a tetrahedron; 'assembly': residual and matrix,",
        "that included; 'GB': peak memory, both together.",
        "",
        "  ".join(f"{name:>{width}}" for name, width in _COLUMNS.items()),
    ]
    for r in (r for r in records if r["kind"] == "mesh"):
        for variant in VARIANTS[:2]:
            lines.append(_mesh_line(r, variant))
        step = _per_step(r, "backtracking") / _per_step(r, "mixed")
        lines.append(
            f"{'':>31} mixed / displacement: an iteration {_ratio(r):.2f}, a step 1/{step:.1f}"
        )
    if found := _growth(records):
        first, last, (mixed, classic, krylov) = found
        lines.append(
            f"{'':>31} from {first['tetrahedra']} to {last['tetrahedra']}, a tetrahedron: mixed "
            f"{mixed:.2f}, displacement {classic:.2f}, CG its {krylov:.2f} times"
        )
    lines += [
        "",
        "Newton iterations and seconds a step, mixed against the better displacement variant",
        "(b: backtracking on the residual, p: projected tangent), and how many times faster:",
        "",
        f"{'E [Pa]':>8} {'h [s]':>6}  {'mixed':>18}  {'displacement':>20}  {'faster':>6}",
    ]
    for r in (r for r in records if r["kind"] == "grid"):
        best, faster = classical(r), _faster(r)
        lines.append(
            f"{r['E']:>8.0e} {r['h']:>6g}  {_cell(r, 'mixed'):>18}  "
            f"{_cell(r, best):>18} {best[0]}  {faster:>6.1f}"
        )
    return lines


def _growth(records: Sequence[Record]) -> tuple[Record, Record, list[float]] | None:
    """How an iteration's cost per tetrahedron grows from 40k tetrahedra to the finest mesh.

    Returns:
        Both ends, and what the cost of the mixed iteration, that of the displacement's and the
        number of linear iterations are multiplied by; None without two meshes.
    """
    rows = [
        r
        for r in records
        if (r["kind"], r["material"]) == ("mesh", "stable-neo-hookean") and r["tetrahedra"] > 4e4
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


_COLUMNS = {
    "tetrahedra": 10,
    "material": 19,
    "Newton": 12,
    "local": 5,
    "assembly": 8,
    "condense": 8,
    "set-up": 6,
    "CG": 6,
    "total": 6,
    "CG its": 6,
    "its/step": 8,
    "s/step": 7,
    "GB": 4,
}


def _mesh_line(r: Record, variant: str) -> str:
    phase: Mapping[str, float] = {name: 1e3 * r[f"{variant}_{name}"] for name in PHASES}
    iterations = r[f"{variant}_iterations"]
    values = (
        str(r["tetrahedra"]),
        r["material"],
        "mixed" if variant == "mixed" else "displacement",
        f"{1e6 * r[f'{variant}_local']:.2f}",
        f"{phase['residual'] + phase['jacobian']:.0f}",
        f"{phase['condensation']:.0f}",
        f"{phase['setup']:.0f}",
        f"{phase['solve']:.0f}",
        f"{1e3 * _per_iteration(r, variant):.0f}",
        f"{_krylov(r, variant):.1f}",
        f"{_median(iterations):.0f}",
        f"{_per_step(r, variant):.2f}",
        f"{r['peak_memory']:.1f}",
    )
    return "  ".join(f"{v:>{w}}" for v, w in zip(values, _COLUMNS.values(), strict=True))


def _cell(r: Record, variant: str) -> str:
    if r[f"{variant}_failure"]:
        return f"fails at step {r[f'{variant}_steps_done'] + 1}"
    return f"{np.mean(r[f'{variant}_iterations']):.1f} its {_per_step(r, variant):.3f} s"


def verdict(records: Sequence[Record]) -> list[str]:
    """Failures of the mixed Newton alone, and costs above what is claimed."""
    lines, many = [], []
    for r in (r for r in records if r["kind"] == "mesh"):
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
    for r in (r for r in records if r["kind"] == "grid"):
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
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Seconds a step over the mesh, and the speed-up over the grid."""
    figure.set_size_inches(9.0, 3.8)
    left, right = figure.subplots(1, 2)
    meshes = [r for r in records if r["kind"] == "mesh" and r["material"] == "stable-neo-hookean"]
    for variant, name in (("mixed", "mixed"), ("backtracking", "displacement")):
        seconds = [_per_step(r, variant) for r in meshes]
        left.loglog([r["tetrahedra"] for r in meshes], seconds, "o-", label=name)
    left.set(xlabel="tetrahedra", ylabel="seconds a step", title="E = 1e7 Pa, h = 0.1 s")
    left.legend()
    cells = [r for r in records if r["kind"] == "grid"]
    E, h = (sorted({r[name] for r in cells}) for name in ("E", "h"))
    faster = np.full((len(h), len(E)), np.nan)
    for r in cells:
        faster[h.index(r["h"]), E.index(r["E"])] = _faster(r)
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
