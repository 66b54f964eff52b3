"""`mixed-fem study preconditioner`: block preconditioners over mesh, stiffness, contrast, ν and h.

A bar of 4 m × 1 m × 1 m, clamped at x = 0, two layers of stable neo-Hookean material, the upper one
`contrast` times as stiff as the lower. It starts to fall under gravity, for two steps; a static bar
gets its weight in two parts. One parameter at a time departs from a base case. Beside the
preconditioners stands the condensed solver with the same linear solver on the displacement; all
assemble by UFL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem, mesh

from demos.studies.memory import forget_peak, peak_memory, release, resident_memory
from demos.studies.records import Column, Record, groups, in_columns, select
from demos.studies.study import Parameters, Study
from forms import BackwardEuler, Fixed, Gravity, Model, StableNeoHookean, by_tag
from meshes import Where, box
from solvers import PRECONDITIONERS, ConvergenceError, MixedProblem, SolveResult
from solvers.options import CONDENSED_CG, CONDENSED_DIRECT, Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

RHO, GRAVITY = 1000.0, 9.81  # [kg/m³], [m/s²]
STATIC = 1e6  # [s], a step in which inertia is less than rounding error

BASE = {"E": 1e7, "contrast": 1.0, "nu": 0.45, "h": 0.1}  # [Pa], [-], [-], [s]
AXES: dict[str, tuple[float, ...]] = {
    "E": (1e4, 1e5, 1e6, 1e8, 1e9, 1e10),
    "contrast": (1e2, 1e4, 1e6, 1e8),
    "nu": (0.3, 0.49, 0.499),
    "h": (1e-3, 1e-2, 1.0, STATIC),
}
"""Values of each parameter apart from the base case's."""

QUICK_AXES = {"E": (1e4, 1e10), "contrast": (1e8,), "nu": (0.3, 0.499), "h": (1e-3, STATIC)}

# Cells across the bar; 24 n³ tetrahedra.
COARSE, FINEST = 4, 26
MESHES = (COARSE, 8, 16)

MUMPS, GAMG = "condensed-mumps", "condensed-gamg"
CONDENSED: dict[str, Options] = {MUMPS: CONDENSED_DIRECT, GAMG: CONDENSED_CG}
"""The condensed solver by what it solves with."""

LIKE = {"schur-full-mumps": MUMPS, "schur-full-gmres": GAMG}
"""What "schur-full" stands for, and the condensed solver that does the same on K."""

FULL = ("schur-full-mumps", "schur-full-gamg", "schur-full-gmres")

METHODS = (*PRECONDITIONERS, *CONDENSED)

MOST_KRYLOV = {"schur-full-mumps": 1, "schur-full-gamg": 25}
GROWTH = 1.3  # of the Krylov iterations of schur-full-gamg over a factor of 8 in tetrahedra
SLOWER = 1.5  # than the condensed solver
SAME = 1e-9  # as the whole system factorised, relative
ROUNDED = 1e-16  # and this times the contrast more: another BLAS or PETSc rounds otherwise


def grid(quick: bool) -> list[Parameters]:
    """Meshes in the base case, then departures from it on the coarsest."""
    some = [*FULL, *CONDENSED]
    cases = []
    for n in MESHES[:2] if quick else MESHES:
        cases += [case("mesh", n, m) for m in (some if quick else METHODS)]
    if not quick:
        cases += [case("mesh", FINEST, m) for m in ("schur-full-gmres", GAMG)]
    for axis, values in (QUICK_AXES if quick else AXES).items():
        cases += [case(axis, COARSE, m, **{axis: value}) for value in values for m in some]
    return cases


def case(axis: str, n: int, method: str, **changes: float) -> Parameters:
    """The parameters of a case that departs from the base case along an axis."""
    return {
        **{"axis": axis, "tetrahedra": 24 * n**3, "n": n, "method": method},
        "steps": 1 if n == FINEST else 2,
        **BASE,
        **changes,
    }


@dataclass
class _Run:
    """Some steps of the bar with one solver.

    Attributes:
        fields: The unknowns.
        results: One for each step that succeeded.
        failure: Why a step did not, or nothing.
    """

    fields: tuple[fem.Function[Any], ...]
    results: list[SolveResult]
    failure: str = ""


def _march(comm: MPI.Comm, parameters: Parameters, **solver: Any) -> _Run:
    n, h, steps = parameters["n"], parameters["h"], parameters["steps"]
    body = box(comm, size=(4.0, 1.0, 1.0), cells=(4 * n, n, n))
    index_map = body.mesh.topology.index_map(3)
    every = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    upper = mesh.compute_midpoints(body.mesh, 3, every)[:, 1] > 0.5
    layers = mesh.meshtags(body.mesh, 3, every, upper.astype(np.int32))
    E, nu = parameters["E"], parameters["nu"]
    psi = by_tag(
        body.mesh,
        layers,
        {0: StableNeoHookean(E, nu), 1: StableNeoHookean(E * parameters["contrast"], nu)},
    )
    weight = Gravity((0.0, -GRAVITY, 0.0))
    if h == STATIC:
        weight.g = lambda t: (0.0, -GRAVITY * t / (steps * h), 0.0)
    model = Model(
        body,
        "symmetric",
        psi,
        rho=RHO,
        loads=[weight],
        motions=[Fixed(Where(extents=(("x", "min"),)))],
    )
    scheme = BackwardEuler(model.u, h)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, **solver)
    run = _Run(model.fields, [])
    for _ in range(steps):
        model.update(scheme)
        comm.barrier()
        try:
            run.results.append(problem.solve())
        except ConvergenceError as error:
            run.failure = error.result.reason
            break
        model.accept(scheme)
    return run


def _solver(method: str) -> dict[str, Any]:
    if method in CONDENSED:
        prefixed = {f"condensed_{key}": value for key, value in CONDENSED[method].items()}
        return {"solver": "condensed", "options": prefixed}
    return {"solver": "fieldsplit", "preconditioner": method}


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Compute the steps, and where the mesh is coarse the same with `direct`. Collective."""
    release(comm)
    forget_peak()
    before = resident_memory()
    run = _march(comm, parameters, **_solver(parameters["method"]))
    memory = comm.allreduce(peak_memory() - before)
    record: Record = {
        "failure": run.failure,
        "newton": [result.iterations for result in run.results],
        "krylov_mean": None,
        "krylov_max": None,
        "seconds": None,
        "memory": memory,
        "difference": None,
    }
    krylov = [k for result in run.results for k in result.krylov]
    if run.failure or not krylov:
        return record
    record["krylov_mean"], record["krylov_max"] = float(np.mean(krylov)), max(krylov)
    last = run.results[-1]
    seconds = comm.allreduce(last.timings["total"], op=MPI.MAX)
    record["seconds"] = seconds / max(last.iterations, 1)
    if parameters["n"] <= COARSE and (whole := _by_direct(comm, parameters)) is not None:
        record["difference"] = max(map(_difference, run.fields[:2], whole))
    return record


def _by_direct(comm: MPI.Comm, parameters: Parameters) -> list[Array] | None:
    """What `direct` makes of u and S, if it gets through; once for all methods. Collective."""
    key = comm.size, *(parameters[name] for name in ("n", "steps", *BASE))
    if key not in _direct:
        run = _march(comm, parameters, solver="direct")
        # Not Y: stresses carry the rounding error of strains times the stiffness.
        _direct[key] = None if run.failure else [f.x.array.copy() for f in run.fields[:2]]
    return _direct[key]


_direct: dict[tuple[Any, ...], list[Array] | None] = {}


def _difference(f: fem.Function, expected: Array) -> float:
    """Relative Euclidean difference of a function from values on the same mesh."""
    comm, owned = f.function_space.mesh.comm, f.function_space.dofmap.index_map.size_local
    size = owned * f.function_space.dofmap.index_map_bs
    a, b = f.x.array[:size], expected[:size]
    squares = comm.allreduce(np.array([np.sum((a - b) ** 2), np.sum(b**2)]))
    return float(np.sqrt(squares[0] / squares[1]))


def _departure(r: Record) -> str:
    """Where a case is in the grid, in words."""
    if r["axis"] == "mesh":
        return "base case"
    value = r[r["axis"]]
    return "static" if value == STATIC else f"{r['axis']} = {value:g}"


def table(records: Sequence[Record]) -> list[str]:
    """A row a case."""
    base = ", ".join(f"{name} = {value:g}" for name, value in BASE.items())
    lines = [
        "",
        f"Base case: {base} (SI units). 'newton': iterations of each step; 'krylov': iterations of",
        "the outer method, or of the condensed solver, a Newton iteration; 's': seconds a Newton",
        "iteration of the last step, with the set-up if that is the first; 'kB/tet': peak memory;",
        "'off': relative difference of u and S from those of `direct`.",
    ]
    cases = groups([{**r, "departure": _departure(r)} for r in records], "tetrahedra", "departure")
    for (tetrahedra, departure), rows in cases.items():
        lines += ["", f"{departure}, {tetrahedra} tetrahedra", *in_columns(rows, COLUMNS, case=1)]
    return lines


COLUMNS: dict[str, Column] = {
    "method": "{method}",
    "newton": lambda r: " ".join(map(str, r["newton"])),
    "krylov": "{krylov_mean:.1f}",
    "max": "{krylov_max}",
    "s": "{seconds:.3f}",
    "kB/tet": lambda r: f"{1e6 * r['memory'] / r['tetrahedra']:.1f}",
    "off": lambda r: "" if r["difference"] is None else f"{r['difference']:.0e}",
}


def verdict(records: Sequence[Record]) -> list[str]:
    """Failures, too many Krylov iterations, their growth, time, and other results than `direct`."""
    lines = []
    where = {
        id(r): f"{r['method']}, {_departure(r)}, {r['tetrahedra']} tetrahedra" for r in records
    }
    for r in records:
        if r["failure"]:
            lines.append(f"{where[id(r)]}: {r['failure']}")
            continue
        most = MOST_KRYLOV.get(r["method"])
        if most is not None and r["krylov_max"] > most:
            lines.append(f"{where[id(r)]}: {r['krylov_max']} Krylov iterations, more than {most}")
        same = SAME + ROUNDED * r["contrast"]
        if r["difference"] is not None and r["difference"] > same:
            lines.append(f"{where[id(r)]}: {r['difference']:.1e} from `direct`, more than {same:g}")
    done = {(_departure(r), r["n"], r["method"]): r for r in records if not r["failure"]}
    for (departure, n, method), r in done.items():
        like = done.get((departure, n, LIKE.get(method, "")))
        # Smaller cases are a matter of Python.
        if like is not None and n > COARSE and r["seconds"] > SLOWER * like["seconds"]:
            lines.append(
                f"{where[id(r)]}: {r['seconds'] / like['seconds']:.2f} times the seconds of "
                f"{like['method']}, more than {SLOWER:g}"
            )
        finer = done.get((departure, 2 * n, method))
        if method != "schur-full-gamg" or finer is None or n <= COARSE:
            continue
        growth = finer["krylov_mean"] / r["krylov_mean"]
        if growth > GROWTH:
            lines.append(
                f"{method}: Krylov iterations grow {growth:.2f} times from {r['tetrahedra']} to "
                f"{finer['tetrahedra']} tetrahedra, more than {GROWTH:g}"
            )
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Krylov iterations and seconds over the mesh, iterations over each other axis."""
    figure.set_size_inches(11.0, 6.5)
    plots = figure.subplots(2, 3).ravel()
    good = select(records, failure="")
    for method in METHODS:
        style = "s--" if method in CONDENSED else "o-"
        rows = select(good, axis="mesh", method=method)
        sizes = [r["tetrahedra"] for r in rows]
        plots[0].loglog(sizes, [r["krylov_mean"] for r in rows], style, ms=3, label=method)
        seconds = [1e6 * r["seconds"] / r["tetrahedra"] for r in rows]
        plots[1].loglog(sizes, seconds, style, ms=3)
        for plot, axis in zip(plots[2:], AXES, strict=True):
            rows = [r for r in select(good, method=method, n=COARSE) if r["axis"] in (axis, "mesh")]
            rows.sort(key=lambda r: r[axis])
            # Over ν the distance to 1/2; a static case stands at the end.
            x = [0.5 - r["nu"] if axis == "nu" else min(r[axis], 10.0) for r in rows]
            plot.loglog(x, [r["krylov_mean"] for r in rows], style, ms=3)
            plot.set_title(f"{24 * COARSE**3} tetrahedra", fontsize=8)
    names = ("E [Pa]", "contrast", "1/2 - ν", "h [s]; 10: static")
    labels = ("tetrahedra", "tetrahedra", *names)
    for k, (plot, label) in enumerate(zip(plots, labels, strict=True)):
        plot.set(xlabel=label, ylabel="µs a tetrahedron" if k == 1 else "Krylov iterations")
    plots[0].legend(fontsize=5)


PRECONDITIONER = Study(
    name="preconditioner",
    description="Krylov iterations, seconds, memory of block preconditioners; mesh, E, ν, h",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
