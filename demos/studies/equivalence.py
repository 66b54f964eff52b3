"""`mixed-fem study equivalence`: where the formulations have the displacement method's solutions.

With P1 displacements and fields that are constant on each cell, S = S(F) can be met on each cell,
and eliminating S and its multiplier leaves the displacement method. So positions must agree to
rounding error: on every scene, mesh and step, whatever the formulation. With other elements
S = S(F) is met at the points of the rule that integrates the energy, and positions are those of
the displacement method with that rule. Cases in which they are not, on a plate whose middle vertex
is pushed aside:

- finer rule: the displacement method integrates Ψ with two degrees more, and they differ by what
  the formulation's rule misses. That is nothing with Q1 on rectangles, where det F is bilinear.
- `mean-dilatation` on other elements than P1 simplices: its dilatation is of lower degree than
  det F, on purpose, and may not follow it.
- inverted: pushed so far that triangles turn over. `hu-washizu` and `log-strain` know F by FᵀF
  alone, which does not see the sign of det F; theirs is another energy there.
- compliant: -|Y|²/(2 κ) added to the energy of `symmetric`, as a regularisation. S = S(F) is then
  missed by Y/κ, as if a spring of stiffness κ stood in series, and positions by order μ/κ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh

from demos.app import scene as scenes
from demos.app.simulation import Simulation, build_body
from demos.studies.records import Column, Record, in_columns, power, select
from demos.studies.study import Parameters, Study
from forms import (
    FORMULATIONS,
    StableNeoHookean,
    deformation_gradient,
    measure,
    quadrature_degree,
)
from meshes import GEOMETRIES, box
from solvers import ConvergenceError, MixedProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

BASELINE = "displacement"
AGREEMENT = 1e-9
"""Difference of positions, relative to the size of the body, that counts as rounding error."""

UNSIGNED = ("hu-washizu", "log-strain")
"""Formulations that do not see the sign of det F."""

MEANS = ("mean-dilatation",)
"""Formulations with a field of lower degree than F, but on P1 simplices."""

PLATE = StableNeoHookean(E=1e5, nu=0.3)
COMPLIANCES = (1e-2, 1e-3, 1e-4, 1e-5)  # μ / κ
PUSH, FAR_PUSH = (0.1, 0.05), (0.4, 0.15)  # of the middle of a plate of 1 m [m]
PUSH_STEPS = 8
ELEMENTS = (("triangle", 2), ("triangle", 3), ("quadrilateral", 1), ("quadrilateral", 2))
EXACT = ("quadrilateral", 1)  # the rule is, for this material on rectangles
FINER = 2  # degrees more of the rule


def grid(quick: bool) -> list[Parameters]:
    """Scenes at some refinements, then the plate."""
    # `taylor-hood` has displacements of another degree.
    others = [name for name in FORMULATIONS if name not in (BASELINE, "taylor-hood")]
    cases: list[Parameters] = [
        scene_case(name, formulation, refinement, 1 if quick else 0)
        for name in scenes.built_in()
        for refinement in ((-1,) if quick else (-1, 0, 1))
        for formulation in (("symmetric", "seed") if quick else others)
    ]
    cases += [plate_case("inverted", formulation) for formulation in others]
    for element in ELEMENTS[::2] if quick else ELEMENTS:
        cases += [plate_case("element", name, element=element) for name in others]
        if element != EXACT:
            cases.append(plate_case("finer rule", "symmetric", element=element))
    return cases + [plate_case("compliant", "symmetric", c) for c in COMPLIANCES]


def scene_case(name: str, formulation: str, refinement: int, steps: int) -> Parameters:
    """The parameters of a scene with 2^refinement as many cells along each edge.

    All of its steps if `steps` is 0.
    """
    return {
        **{"kind": "scene", "scene": name, "formulation": formulation},
        **{"refinement": refinement, "steps": steps},
    }


def plate_case(
    kind: str,
    formulation: str,
    compliance: float = 0.0,
    element: tuple[str, int] = ("triangle", 1),
) -> Parameters:
    """The parameters of a case of the plate; an element is a cell and the displacement's degree."""
    cell, degree = element
    return {
        **{"kind": kind, "formulation": formulation, "compliance": compliance},
        **{"cell": cell, "degree": degree},
    }


def compute(comm: MPI.Comm, parameters: Parameters) -> Record:
    """Solve with the formulation and with the displacement alone, and compare. Collective."""
    if parameters["kind"] == "scene":
        return _on_a_scene(comm, parameters)
    return _on_a_plate(comm, parameters)


def _on_a_scene(comm: MPI.Comm, parameters: Parameters) -> Record:
    name, refinement = parameters["scene"], parameters["refinement"]
    scene = scenes.load(comm, name, scenes.Overrides(steps=parameters["steps"] or None))
    body = build_body(dataclasses.replace(scene, mesh=_refined(scene.mesh, refinement)), comm)
    runs = [
        Simulation(dataclasses.replace(scene, formulation=name, globalisation=None), body)
        for name in (parameters["formulation"], BASELINE)
    ]
    marches = [run.march(scene.steps) for run in runs]
    size = float(np.max(comm.allreduce(body.mesh.geometry.x.max(initial=0.0), op=MPI.MAX)))
    differences, iterations = [], []
    failure = ""
    for _ in range(scene.steps):
        try:
            iterations.append([next(march).iterations for march in marches])
        except ConvergenceError as error:
            failure = error.result.reason
            break
        differences.append(_difference(comm, *(run.fields[0] for run in runs)) / size)
    return {
        "cells": body.num_cells,
        "failure": failure,
        "difference": max(differences, default=float("nan")),
        "differences": differences,
        "iterations": iterations,
    }


def _refined(source: scenes.MeshSource, refinement: int) -> scenes.MeshSource:
    """The same mesh with 2^refinement as many cells along each edge.

    One of a geometry is no finer than it is, as that takes hours; one from a file stays as it is.
    """
    if source.file is not None:
        return source
    if source.geometry is not None:
        h = source.h or GEOMETRIES[source.geometry].h
        return dataclasses.replace(source, h=h / 2.0 ** min(refinement, 0))
    cells = tuple(max(1, round(n * 2.0**refinement)) for n in source.cells)
    return dataclasses.replace(source, cells=cells)


def _difference(comm: MPI.Comm, u: fem.Function[Any], v: fem.Function[Any]) -> float:
    largest = np.abs(u.x.array - v.x.array).max(initial=0.0)
    return float(comm.allreduce(largest, op=MPI.MAX))


def _on_a_plate(comm: MPI.Comm, parameters: Parameters) -> Record:
    kind, degree = parameters["kind"], parameters["degree"]
    msh = box(comm, (1.0, 1.0), (4, 4), parameters["cell"]).mesh
    baseline = _Plate(msh, BASELINE, degree, finer=FINER if kind == "finer rule" else 0)
    compliance = parameters["compliance"] / PLATE.mu
    plate = _Plate(msh, parameters["formulation"], degree, compliance)
    push = np.array(FAR_PUSH if kind == "inverted" else PUSH)
    u, v = plate.fields[0], baseline.fields[0]
    try:
        for k in range(1, PUSH_STEPS + 1):
            baseline.solve(push * k / PUSH_STEPS)
        # Beyond det F = 0, which √(FᵀF) does not get across.
        u.x.array[:] = v.x.array
        plate.solve(push)
    except ConvergenceError as error:
        return {"failure": error.result.reason, "difference": float("nan")}
    return {"failure": "", "difference": _difference(comm, u, v), "inverted": plate.inverted()}


class _Plate:
    """A square of 1 m with its edges held and its middle pushed aside."""

    def __init__(
        self,
        msh: mesh.Mesh,
        formulation: str,
        degree: int,
        compliance: float = 0.0,
        finer: int = 0,
    ) -> None:
        """Build it at rest.

        Args:
            msh: The mesh.
            formulation: A name in `forms.FORMULATIONS`.
            degree: Of the displacement.
            compliance: In series [1/Pa], for `symmetric`.
            finer: What to add to the degree of the rule, for the displacement method.
        """
        form = FORMULATIONS[formulation]
        self.fields = form.fields(msh, degree)
        V = self.fields[0].function_space
        density = form.density(*self.fields, PLATE)
        if compliance:
            _, _, Y = self.fields
            density -= fem.Constant(msh, compliance) / 2 * ufl.inner(Y, Y)
        dofs = fem.locate_dofs_geometrical(
            V, lambda X: np.isclose(np.abs(X[:2] - 0.5), 0.5).any(axis=0) | _middle(X)
        )
        self._held = fem.Function(V)
        bc = fem.dirichletbc(self._held, dofs)
        rule = quadrature_degree(V) + finer
        dx = ufl.dx(degree=rule) if finer else measure(self.fields[0])
        self._problem = MixedProblem(density * dx, self.fields, [bc])

    def solve(self, push: Array) -> None:
        """Put the middle vertex `push` [m] from where it was at rest. Collective."""
        self._held.interpolate(lambda X: push[:, None] * _middle(X))
        self._problem.solve()

    def inverted(self) -> int:
        """Number of cells with det F < 0. Collective."""
        u = self.fields[0]
        msh = u.function_space.mesh
        cells = np.arange(msh.topology.index_map(2).size_local, dtype=np.int32)
        J = fem.Expression(ufl.det(deformation_gradient(u)), np.full((1, 2), 1 / 3))
        return int(msh.comm.allreduce(int(np.sum(J.eval(msh, cells) < 0.0))))


def _middle(X: Array) -> npt.NDArray[np.bool_]:
    return np.asarray(np.isclose(X[:2], 0.5).all(axis=0))


# What to show


_SCENES: dict[str, Column] = {
    "scene": "{scene}",
    "cells": "{cells}",
    "formulation": "{formulation}",
    "steps": lambda r: str(len(r["differences"])),
    "difference": "{difference:.1e}",
    "Newton": lambda r: " / ".join(str(sum(n)) for n in zip(*r["iterations"], strict=True)),
    "": "{failure}",
}
_INVERTED: dict[str, Column] = {
    "formulation": "{formulation}",
    "difference": "{difference:.1e}",
    "inverted": "{inverted}",
}
_ELEMENTS: dict[str, Column] = {
    "element": "{cell}, degree {degree}",
    "formulation": lambda r: r["formulation"] if r["kind"] == "element" else "against a finer rule",
    "difference": "{difference:.1e}",
}
_COMPLIANT: dict[str, Column] = {"μ/κ": "{compliance:.0e}", "difference": "{difference:.3e}"}


def table(records: Sequence[Record]) -> list[str]:
    """Largest differences of a position, relative to the size of the body."""
    elements = select(records, kind="element") + select(records, kind="finer rule")
    compliant = select(records, kind="compliant")
    lines = [
        "",
        "Largest difference of a position from the displacement method's, over the body's size",
    ]
    for title, chosen, columns, case in (
        ("scenes:", select(records, kind="scene"), _SCENES, 0),
        ("plate with inverted cells:", select(records, kind="inverted"), _INVERTED, 1),
        ("plate of other elements, fields at the points of the rule:", elements, _ELEMENTS, 2),
        ("plate with a compliance in series (-|Y|²/(2 κ)):", compliant, _COMPLIANT, 1),
    ):
        if chosen:
            lines += ["", title, *in_columns(chosen, columns, case)]
    if len(compliant) > 1:
        lines.append(f"order in μ/κ: {order_of_compliance(compliant):.2f}")
    return lines


def order_of_compliance(rows: Sequence[Record]) -> float:
    """The power of μ/κ that the differences follow."""
    return power((r["compliance"] for r in rows), (r["difference"] for r in rows))


def verdict(records: Sequence[Record]) -> list[str]:
    """Differences where there should be none, the other way round, and Newton methods that fail."""
    lines = []
    for r in records:
        name = f"{r.get('scene', r['kind'])}, {r['formulation']}"
        if r["failure"]:
            if FORMULATIONS[r["formulation"]].exact:  # others converge linearly, if at all
                lines.append(f"{name}: {r['failure']}")
            continue
        differs = (
            r["kind"] in ("compliant", "finer rule")
            or (r["kind"] == "inverted" and r["formulation"] in UNSIGNED)
            or (r["kind"] == "element" and r["formulation"] in MEANS)
        )
        if differs != (r["difference"] > AGREEMENT):
            side = "more" if differs else "less"
            lines.append(f"{name}: differs by {r['difference']:.1e}, expected {side} than 1e-9")
    rows = select(records, kind="compliant", failure="")
    if len(rows) > 1 and not abs(order_of_compliance(rows) - 1) < 0.05:
        lines.append(f"compliant: order {order_of_compliance(rows):.2f} in μ/κ, expected 1")
    return lines


def draw(records: Sequence[Record], figure: Figure) -> None:
    """Differences by step on the scenes, and on the plate."""
    figure.set_size_inches(11.0, 3.8)
    left, middle, right = figure.subplots(1, 3, width_ratios=(5, 4, 3))
    names = list(FORMULATIONS)
    labelled = set()
    for r in select(records, kind="scene"):
        name = r["formulation"]
        # An exact agreement has no logarithm.
        values = np.maximum(r["differences"], 1e-17)
        style = {"ms": 3, "lw": 0.7, "color": f"C{names.index(name)}"}
        label = "" if name in labelled else name
        left.semilogy(range(1, len(values) + 1), values, "o-", label=label, **style)
        labelled.add(name)
    left.set(xlabel="step", ylabel="difference / size of the body", title="scenes, all meshes")
    left.xaxis.get_major_locator().set_params(integer=True)
    left.set_ylim(1e-17, 1.0)
    left.axhline(AGREEMENT, color="k", lw=0.7, ls=":", label="what counts as equal")
    left.legend(fontsize=7)
    rows = select(records, kind="inverted", failure="")
    labels = [r["formulation"] for r in rows]
    colors = [f"C{names.index(name)}" for name in labels]
    middle.barh(labels, [max(r["difference"], 1e-17) for r in rows], left=1e-17, color=colors)
    middle.set_xscale("log")
    middle.set_xlim(1e-17, 1.0)
    middle.axvline(AGREEMENT, color="k", lw=0.7, ls=":")
    middle.set(xlabel="difference / size of the body", title="inverted cells")
    rows = select(records, kind="compliant", failure="")
    right.loglog([r["compliance"] for r in rows], [r["difference"] for r in rows], "ko-", ms=4)
    right.set(xlabel="μ / κ", title="compliance in series")
    right.grid(alpha=0.3)


EQUIVALENCE = Study(
    name="equivalence",
    description="positions against the displacement method's, on every scene; where they differ",
    grid=grid,
    compute=compute,
    table=table,
    draw=draw,
    verdict=verdict,
)
