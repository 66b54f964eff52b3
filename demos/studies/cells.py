"""What the engine costs: work at a point, the way to the first iteration, memory. Part of `cost`.

Energies are those of every formulation with every material, and one that is written here as a user
would write it, with a strain energy of its own.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
import ufl

from demos.studies.bar import bar
from demos.studies.ranks import on_ranks
from demos.studies.records import Column, Record, in_columns, select
from demos.studies.study import Parameters
from forms import FORMULATIONS, MATERIALS
from solvers import MixedProblem
from solvers.engine.system import EngineProblem

OWN = "own"
"""The strain energy of the README, 3.8e6 |S - I|² + 1e7 tr⁴(S - I), in place of a material."""

SPECTRAL = ("hencky", "ogden")  # materials of eigenvalues
FAST = ("stable-neo-hookean", "as-rigid-as-possible", "corotational", OWN)  # with `symmetric`
LIMITS = {"fast": 1.0, "few": 2.0, "many": 4.0, "eigenvalues": 5.0}  # [µs] a point
FEW = 12  # local unknowns
START = {2: 2.0, 3: 3.0}  # [s], by dimension
MEMORY = 4.0  # [GB]


def own(S: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    """The README's strain energy [J/m³]."""
    strain = S - ufl.Identity(S.ufl_shape[0])
    return 3.8e6 * ufl.inner(strain, strain) + 1e7 * ufl.tr(strain) ** 4


def grid(quick: bool) -> list[Parameters]:
    """Each formulation with each material on one mesh; starts; one large element."""
    n = 4 if quick else 16
    formulations = ("symmetric", "displacement", "seed") if quick else FORMULATIONS
    materials = FAST if quick else (*MATERIALS, OWN)
    cases = [_case("local", f, m, 3, n) for f in formulations for m in materials]
    cases += [_case("start", "symmetric", OWN, d, 3) for d in (2, 3)]
    return [*cases, _case("memory", "symmetric", "stable-neo-hookean", 3, 2 if quick else 8)]


def _case(kind: str, formulation: str, material: str, dimension: int, n: int) -> Parameters:
    return {
        **{"kind": kind, "formulation": formulation, "material": material},
        **{"dimension": dimension, "n": n},
    }


def compute(comm: MPI.Comm, case: Parameters) -> Record:
    """Measure one case. Collective."""
    if case["kind"] == "local":
        return _local(comm, case)
    code, timeout = (_FIRST_ITERATION, 120.0) if case["kind"] == "start" else (_LARGE, 1200.0)
    answer = ""
    if comm.rank == 0:
        with tempfile.TemporaryDirectory() as folder:
            arguments = folder, str(case["dimension"]), str(case["n"])
            answer = on_ranks(1, code, *arguments, timeout=timeout)
    return {"value": float(comm.bcast(answer).split()[-1])}


def _local(comm: MPI.Comm, case: Parameters) -> Record:
    """Microseconds of processor time a point: residual, matrix and elimination, recovery."""
    psi = own if case["material"] == OWN else None
    material = "corotational" if psi else case["material"]
    run = bar(comm, case["formulation"], n=case["n"], E=1e7, h=0.1, material=material, psi=psi)
    sizes = _engine(run.problem).kernels[0].sizes
    return {"seconds": local_work(run.problem), "local unknowns": sizes["NL"] + sizes["NC"]}


def _engine(problem: MixedProblem) -> EngineProblem:
    assert isinstance(problem.problem, EngineProblem)
    return problem.problem


def local_work(mixed: MixedProblem) -> dict[str, float]:
    """Processor seconds a point of this rank by phase, medians of five.

    Each time at another displacement, so that the kinematics count once.
    """
    problem = _engine(mixed)
    (kernel,) = problem.kernels
    u = problem.fields[0]
    X = u.function_space.tabulate_dof_coordinates()[:, : len(u)]
    before = u.x.array.copy()
    arrays = [np.zeros_like(f.x.array) for f in problem.fields]
    times: dict[str, list[float]] = {"residual": [], "matrix": [], "recovery": []}
    for k in range(6):
        u.x.array[:] = before + (1 + k) * 1e-3 * (X[:, ::-1] ** 2).ravel()
        for phase, work in (
            ("residual", lambda: kernel.residual(arrays)),
            ("matrix", lambda: problem.condense_cells(arrays)),
            ("recovery", lambda: kernel.recover(arrays)),
        ):
            start = time.process_time()
            work()
            times[phase].append(time.process_time() - start)
    u.x.array[:] = before
    points = kernel.sizes["POINTS"] * max(kernel.cells, 1)
    # The first loads what is not in memory.
    return {phase: float(np.median(values[1:])) / points for phase, values in times.items()}


def kind_of(r: Record) -> str:
    """Which limit a case has."""
    if r["material"] in SPECTRAL or r["formulation"] == "log-strain":
        return "eigenvalues"
    if r["formulation"] == "symmetric" and r["material"] in FAST:
        return "fast"
    return "few" if r["local unknowns"] <= FEW else "many"


def microseconds(r: Record) -> float:
    """Of all local work of a Newton iteration at a point."""
    return 1e6 * sum(r["seconds"].values())


def table(records: Sequence[Record]) -> list[str]:
    """Local work, starts and memory."""
    starts = [f"{r['value']:.1f} s in {r['dimension']}D" for r in select(records, kind="start")]
    lines = ["", "Processor time in the cells a point and Newton iteration [µs], one core:", ""]
    lines += in_columns(select(records, kind="local"), _LOCAL)
    lines += ["", f"From a new energy to its first Newton iteration: {', '.join(starts)}"]
    for r in select(records, kind="memory"):
        lines.append(f"{r['n']}³ cubic hexahedra, a Newton iteration: {r['value']:.1f} GB at most")
    return lines


_LOCAL: dict[str, Column] = {
    "formulation": "{formulation}",
    "material": "{material}",
    "local unknowns": "{local unknowns}",
    **{
        phase: lambda r, phase=phase: f"{1e6 * r['seconds'][phase]:.2f}"  # type: ignore[misc]
        for phase in ("residual", "matrix", "recovery")
    },
    "all": lambda r: f"{microseconds(r):.2f}",
    "at most": lambda r: f"{LIMITS[kind_of(r)]:g}",
}


def verdict(records: Sequence[Record]) -> list[str]:
    """What is above its limit."""
    lines = [
        f"{r['formulation']} with {r['material']}: {microseconds(r):.2f} µs a point, more than "
        f"{LIMITS[kind_of(r)]:g}"
        for r in select(records, kind="local")
        if not microseconds(r) <= LIMITS[kind_of(r)]
    ]
    lines += [
        f"{r['dimension']}D: {r['value']:.1f} s to the first iteration, more than "
        f"{START[r['dimension']]:g}"
        for r in select(records, kind="start")
        if not r["value"] <= START[r["dimension"]]
    ]
    return lines + [
        f"{r['n']}³ cubic hexahedra: {r['value']:.1f} GB, more than {MEMORY:g}"
        for r in select(records, kind="memory")
        if not r["value"] <= MEMORY
    ]


# Run in a process of its own, with no compiled code on disk: seconds from the energy to the end of
# the first Newton iteration.
_FIRST_ITERATION = """
import os, sys
os.environ["XDG_CACHE_HOME"] = sys.argv[1]
from mpi4py import MPI
import time
import numpy as np
import ufl
from dolfinx import fem
from demos.studies.cells import own
from forms import BackwardEuler, deformation_gradient, mixed_fields, polar_rotation
from meshes import Where, box
from solvers import MixedProblem
d, n = int(sys.argv[2]), int(sys.argv[3])
body = box(MPI.COMM_WORLD, (4.0, 1.0, 1.0)[:d], (4 * n, n, n)[:d])
start = time.perf_counter()
u, S, Y = mixed_fields(body.mesh)
F = deformation_gradient(u)
R = polar_rotation(F)
euler = BackwardEuler(u, h=0.1, acceleration=(0.0, -9.81, 0.0)[:d])
energy = (euler.kinetic(1000.0) + own(S) - ufl.inner(R * Y, R * S - F)) * ufl.dx
V = u.function_space
clamped = fem.dirichletbc(np.zeros(d), body.dofs(V, Where(extents=(("x", "min"),))), V)
problem = MixedProblem(energy, (u, S, Y), [clamped], options={"snes_max_it": 1})
try:
    problem.solve()
except RuntimeError:  # one iteration does not converge
    pass
print(time.perf_counter() - start)
"""

# Peak memory of a Newton iteration on n³ cubic hexahedra, in a process of its own.
_LARGE = """
import sys
from mpi4py import MPI
from demos.studies.memory import peak_memory
from forms import BackwardEuler, Fixed, Gravity, Model, StableNeoHookean
from meshes import Where, box
from solvers import MixedProblem
n = int(sys.argv[3])
body = box(MPI.COMM_WORLD, (1.0, 1.0, 1.0), (n, n, n), "hexahedron")
model = Model(
    body,
    "symmetric",
    StableNeoHookean(1e6, 0.3),
    rho=1000.0,
    loads=[Gravity((0.0, -9.81, 0.0))],
    motions=[Fixed(Where(extents=(("x", "min"),)))],
    degree=3,
)
energy = model.energy(BackwardEuler(model.u, 0.1))
problem = MixedProblem(energy, model.fields, model.bcs, options={"snes_max_it": 1})
try:
    problem.solve()
except RuntimeError:
    pass
print(peak_memory())
"""
