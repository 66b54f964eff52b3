"""What UFL says: energies and blocks on small bodies, at several states, as plain arrays.

`_Forms` is the one place that builds UFL forms, from the functions that users build theirs from.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from demos.app.progress import Screen
from demos.by_hand import MATERIALS as WITNESSED
from demos.by_hand import symmetric_basis, symmetric_dofs
from demos.by_hand.compare.assembly import (
    FIELDS,
    Array,
    Assembler,
    Derivatives,
    Functional,
    without_optimisation,
)
from demos.by_hand.compare.bodies import (
    BODIES,
    STATES,
    E,
    TimeStep,
    make_body,
    make_step,
    rest_state,
)
from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    deformation_gradient,
    polar_rotation,
    refresh,
    seed_singular,
    symmetric,
)
from forms.compilation import compile_together
from meshes import Body
from solvers import MixedProblem

SYSTEMS = ("seed", "symmetric")


@dataclass(frozen=True, eq=False)
class Case:
    """One body, formulation, material and state, with all that UFL gives there.

    Arrays are numbered as in `demos.by_hand`. Increments and results of a step are dicts by the
    letter of the field, flat.

    Attributes:
        names: Body, formulation, material and state.
        step: The state, and the time step to be taken.
        unknowns: (x, s, λ) of the iterate.
        delta: An arbitrary increment (δx, δs, δλ).
        kinetic: E_M, by x.
        elastic: E_Ψ, by s.
        constraint: E_Λ, that is minus the multiplier's term of the energy.
        total: The energy of the formulation, of which the solver takes the derivatives.
        moved: That energy at the iterate plus `delta` [J].
        first_iteration: E_M and ∂E_M/∂x at the iterate plus δx if the step starts at the iterate.
        kinematics: Cell by cell and times V_K: RS, F, J, R, dR, W, W_hat. Seed only.
        newton: The new (x, s, λ) less the old (x, s), by the package's solver.
    """

    names: tuple[str, str, str, str]
    step: TimeStep
    unknowns: Mapping[str, Array]
    delta: Mapping[str, Array]
    kinetic: Derivatives
    elastic: Derivatives
    constraint: Derivatives
    total: Derivatives
    moved: float
    first_iteration: tuple[float, Array]
    kinematics: Mapping[str, Array]
    newton: Mapping[str, Array]


def ufl_cases(
    comm: MPI.Comm,
    screen: Screen,
    bodies: tuple[str, ...] = BODIES,
    materials: tuple[str, ...] = tuple(WITNESSED),
) -> list[Case]:
    """Assemble every case, the same on all ranks. Collective."""
    cases: list[Case] = []
    for k, body in enumerate(bodies):
        screen.progress("UFL", k, len(bodies), f"next: {body}")
        with without_optimisation():
            side = _Side(comm, body, materials)
        cases += [case for formulation in SYSTEMS for case in side.cases(formulation)]
    screen.progress("UFL", len(bodies), len(bodies))
    return cases


class _Forms:
    """UFL's forms on one body. All that changes from case to case is data, so that they are shared.

    Attributes:
        fields: (u, S, multiplier) by formulation, with the same u and S.
        scheme: Backward Euler.
        rho: Density of each cell.
        kinetic: E_M, by x.
        elastic: E_Ψ, by s.
        constraint: E_Λ by formulation.
        total: The energy of each formulation.
        problem: The package's solver for it.
        kinematics: What Λ tests.
    """

    def __init__(self, body: Body, materials: tuple[str, ...]) -> None:
        msh = body.mesh
        u, S, Lam = FORMULATIONS["seed"].fields(msh)
        Y = FORMULATIONS["symmetric"].fields(msh)[-1]
        self.fields = {"seed": (u, S, Lam), "symmetric": (u, S, Y)}
        self.scheme = BackwardEuler(u, h=1.0)
        self.rho = fem.Function(fem.functionspace(msh, ("DG", 0)))
        self._weights = {name: fem.Constant(msh, 0.0) for name in materials}
        self._mu, self._lam = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0)
        kinetic = self.scheme.kinetic(self.rho) * ufl.dx
        self.kinetic = Functional(kinetic, {"x": u})
        self.elastic = Functional(self._psi(S) * ufl.dx, {"s": S})
        self.constraint, self.total, self.problem = {}, {}, {}
        for name, without_psi in (("seed", seed_singular), ("symmetric", symmetric)):
            fields = self.fields[name]
            letters = dict(zip(FIELDS, fields, strict=True))
            constraint = -without_psi(*fields, lambda S: ufl.as_ufl(0)) * ufl.dx
            energy = FORMULATIONS[name].density(*fields, self._psi) * ufl.dx + kinetic
            self.constraint[name] = Functional(constraint, letters)
            self.total[name] = Functional(energy, letters)
            self.problem[name] = MixedProblem(energy, fields, solver="direct")
        self.kinematics = _Kinematics(u, S, Lam)

    def _psi(self, S: Expr) -> Expr:
        """The strain energies of all materials, with weights of which one is not zero."""
        return sum(
            weight * MATERIALS[name](E, 0.0).strain_energy(S, self._mu, self._lam)
            for name, weight in self._weights.items()
        )

    def set_material(self, name: str, nu: float) -> None:
        """Make Ψ that of a material."""
        for other, weight in self._weights.items():
            weight.value[...] = other == name
        law = MATERIALS[name](E, nu)
        self._mu.value[...], self._lam.value[...] = law.mu, law.lam


class _Side:
    """UFL's side of one body."""

    def __init__(self, comm: MPI.Comm, name: str, materials: tuple[str, ...]) -> None:
        self._name, self._materials = name, materials
        body = make_body(comm, name)
        self._assembler = Assembler(body)
        self._forms = _Forms(body, materials)
        self._rest = rest_state(body)

    def cases(self, formulation: str) -> Iterator[Case]:
        """Assemble at every state, with every material."""
        for kind in STATES:
            yield from self._cases(formulation, kind, make_step(self._rest, kind, formulation))

    def _cases(self, formulation: str, kind: str, step: TimeStep) -> Iterator[Case]:
        at, forms, fields = self._assembler, self._forms, self._forms.fields[formulation]
        full = formulation == "seed"
        Lam = step.iterate.Lam if full else symmetric_dofs(step.iterate.Lam)
        X, x, s = step.iterate.X.ravel(), step.iterate.x.ravel(), step.iterate.s.ravel()
        now = {"x": x, "s": s, "l": Lam.ravel()}
        rng = np.random.default_rng(10 + list(STATES).index(kind))
        sizes = dict(zip(FIELDS, (0.1, 0.2, E), strict=True))
        delta = {i: sizes[i] * rng.uniform(-1.0, 1.0, now[i].shape) for i in FIELDS}

        def put(unknowns: Mapping[str, Array]) -> None:
            for i, f in zip(FIELDS, fields, strict=True):
                at.put(f, unknowns[i] - X if i == "x" else unknowns[i])

        self._set_step(step, start=step.iterate.x)
        put({i: now[i] + delta[i] for i in FIELDS})
        first = forms.kinetic.at(at)
        self._set_step(step, start=step.start)
        moved = {}
        for material in self._materials:
            forms.set_material(material, step.nu)
            moved[material] = forms.total[formulation].value(at)
        put(now)
        kinetic, constraint = forms.kinetic.at(at), forms.constraint[formulation].at(at)
        kinematics = forms.kinematics.at(at) if full else {}
        for material in self._materials:
            forms.set_material(material, step.nu)
            elastic = forms.elastic.at(at)
            total = forms.total[formulation].at(at)
            forms.problem[formulation].newton_step(apply=True)
            new = {i: at.values(f) for i, f in zip(FIELDS, fields, strict=True)}
            put(now)
            yield Case(
                (self._name, formulation, material, kind),
                step,
                now,
                delta,
                kinetic=kinetic,
                elastic=elastic,
                constraint=constraint,
                total=total,
                moved=moved[material],
                first_iteration=(first.value, first.first["x"]),
                kinematics=kinematics,
                newton={"x": X + new["x"] - x, "s": new["s"] - s, "l": new["l"]},
            )

    def _set_step(self, step: TimeStep, start: Array) -> None:
        """Give the kinetic energy its data.

        The package's f_ext is one for the whole body. The rest of it, f - f̄, goes with the
        velocity, as x̃ = x^t + h (ẋ^t + h f_ext).
        """
        put, scheme, mean = self._assembler.put, self._forms.scheme, step.f_ext.mean(axis=0)
        scheme.h.value[...] = step.h
        scheme.acceleration.value[:] = mean
        put(scheme.v, step.velocity + step.h * (step.f_ext - mean))
        put(scheme.u_old, start - step.iterate.X)
        put(self._forms.rho, step.rho)


class _Kinematics:
    """Cell by cell, times V_K: what the full DG0 matrices of Λ test."""

    def __init__(self, u: fem.Function[Any], S: fem.Function[Any], Lam: fem.Function[Any]) -> None:
        T = ufl.TestFunction(Lam.function_space)
        du, dS = (ufl.TrialFunction(f.function_space) for f in (u, S))
        self._spaces = {i: f.function_space for i, f in zip(FIELDS, (u, S, Lam), strict=True)}
        self._B = fem.Constant(u.function_space.mesh, np.zeros(S.ufl_shape))
        F = deformation_gradient(u)
        self._R = R = polar_rotation(F)

        J, dR = ufl.derivative(F, u, du), ufl.derivative(R, u, du)

        def against(*tensors: Expr) -> list[ufl.Form]:
            return [ufl.inner(tensor, T) * ufl.dx for tensor in tensors]

        vectors, matrices, (self._W_hat,) = compile_together(
            [
                against(R * S, F, R),
                against(J, dR, R * dS),
                against(ufl.derivative(R * self._B, u, du)),
            ]
        )
        self._vectors = dict(zip(("RS", "F", "R"), vectors, strict=True))
        self._matrices = dict(zip(("J", "dR", "W"), zip(matrices, "xxs", strict=True), strict=True))

    def at(self, assembler: Assembler) -> dict[str, Array]:
        """Assemble; W_hat has a matrix for each dof of S."""
        V = self._spaces["l"]
        refresh([self._R])
        arrays = {name: assembler.vector(form, V) for name, form in self._vectors.items()}
        for name, (form, i) in self._matrices.items():
            arrays[name] = assembler.matrix(form, V, self._spaces[i])
        W_hat = []
        for B in symmetric_basis(self._B.ufl_shape[0]):
            self._B.value[:] = B
            W_hat.append(assembler.matrix(self._W_hat, V, self._spaces["x"]))
        arrays["W_hat"] = np.array(W_hat)
        return arrays
