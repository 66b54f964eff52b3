"""What a body is: formulation, strain energy, density, loads, motions and history variables."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from forms.body import BodyLike
from forms.cell_data import refresh
from forms.compilation import compile_together
from forms.constants import as_constant
from forms.damping import Rayleigh
from forms.fields import cell_not_finite, point_field
from forms.formulations import FORMULATIONS, Fields, Formulation
from forms.history import History
from forms.inversion import InvertedCells
from forms.kinematics import deformation_gradient
from forms.loads import Load
from forms.materials import Material, StrainEnergy
from forms.motions import Motion
from forms.points import measure
from forms.rotation import right_stretch
from forms.stress import first_piola_kirchhoff_stress
from forms.time import Scheme

logger = logging.getLogger("mixed_fem")


class Model:
    """A body in one formulation, from which the terms of its equations of motion follow.

        model = Model(body, "symmetric", psi, rho=1000.0, loads=[Gravity(g)],
                      motions=[Fixed(Where(extents=(("x", "min"),)))])
        scheme = BackwardEuler(model.u, h=0.1)
        problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
        for _ in range(steps):
            model.update(scheme)
            problem.solve()
            model.accept(scheme)

    Attributes:
        body: The body.
        form: The formulation.
        psi: The strain energy density.
        rho: Density [kg/m³], an expression, or None.
        fields: The unknowns, the displacement first.
        u: The displacement [m].
        loads: The loads.
        histories: The history variables.
        damping: Rayleigh damping, or None.
        held: The motions of this displacement.
        bcs: The Dirichlet conditions of all motions.
    """

    def __init__(
        self,
        body: BodyLike,
        formulation: str | Formulation,
        psi: StrainEnergy,
        *,
        rho: float | Expr | None = None,
        loads: Sequence[Load] = (),
        motions: Sequence[Motion] = (),
        histories: Sequence[History] = (),
        damping: Rayleigh | None = None,
        degree: int = 1,
    ) -> None:
        """Make the fields, at rest, and the conditions. Collective.

        Args:
            body: The body.
            formulation: A name in `FORMULATIONS`, or one that is not there.
            psi: Strain energy density [J/m³], a function of the right stretch.
            rho: Density [kg/m³]; not needed in statics without gravity.
            loads: See `forms.loads`.
            motions: See `forms.motions`. Where two hold the same point, the last counts.
            histories: See `forms.history`.
            damping: See `forms.damping`.
            degree: Of the element.

        Raises:
            ValueError: There is no such formulation; a density that is not positive; cells or a
                degree that it does not take; damping by a stiffness that is not known; or what the
                body raises for a part that it does not have.
        """
        if isinstance(formulation, str) and formulation not in FORMULATIONS:
            known = ", ".join(FORMULATIONS)
            raise ValueError(f"formulation is {formulation!r}; available: {known}")
        self.body = body
        self.form = FORMULATIONS[formulation] if isinstance(formulation, str) else formulation
        self.psi = psi
        if isinstance(rho, int | float) and not (np.isfinite(rho) and rho > 0.0):
            raise ValueError(f"rho is {rho}; the density [kg/m³] must be positive and finite")
        self.rho = None if rho is None else as_constant(rho, body.mesh)
        self.fields: Fields = self.form.fields(body.mesh, degree)
        self.u = self.fields[0]
        self.loads = list(loads)
        self.histories = list(histories)
        self.damping = damping
        self._S_old: fem.Function | None = None
        if damping is not None and damping.stiffness > 0.0:
            if damping.moduli is None and not isinstance(psi, Material):
                raise ValueError("damping needs the moduli of the material; give it moduli = ...")
            d = body.mesh.geometry.dim
            self._S_old = point_field(
                body.mesh,
                np.eye(d),
                degree=self.form.degree_of_u(degree),
                symmetric=True,
                name="S_old",
            )
            self.histories.append(History(self._S_old, Model.stretch))
        self._inverted = None if self.form.sees_inversion else InvertedCells(self.u)
        self._known_inverted = 0
        self.held = [motion.hold(body, self.u.function_space) for motion in motions]
        self.bcs: list[fem.DirichletBC] = [bc for held in self.held for bc in held.bcs]

    def energy(self, scheme: Scheme) -> ufl.Form:
        """Return what a step makes stationary [J], a functional of the fields.

        Args:
            scheme: Of `u`.

        Raises:
            ValueError: The scheme moves another displacement; it or a load needs a density, and
                there is none; or Ψ is not of the kind that the formulation takes.
        """
        if scheme.u is not self.u:
            raise ValueError("the scheme moves another displacement than that of the model")
        u = scheme.point(self.u)
        energy = self.form.density(u, *self.fields[1:], self.psi) * measure(self.u)
        if scheme.inertial:
            energy += scheme.kinetic(self._density(scheme)) * ufl.dx
        damping = [term for term in self.damping_potentials(scheme) if term is not None]
        return sum((*self.potentials(u), *damping), energy)

    def virtual_work(self, scheme: Scheme) -> ufl.Form | None:
        """Return the work [J] that loads without a potential do on a test function of u.

        In a step the derivative of `energy` equals it. None if every load has a potential.
        """
        test = ufl.TestFunction(self.u.function_space)
        u = scheme.point(self.u)
        v = ufl.algorithms.expand_derivatives(ufl.derivative(u, self.u, test))
        terms = [load.work(self.body, u, v) for load in self.loads]
        done = [term for term in terms if term is not None]
        return total(done)

    def update(self, scheme: Scheme) -> None:
        """Put motions at the end of the coming step, and loads where the scheme takes them."""
        for held in self.held:
            held.set_time(scheme.end)
        for load in self.loads:
            load.set_time(scheme.point_time)

    def accept(self, scheme: Scheme) -> None:
        """End a step: update the history variables, then advance the scheme. Collective.

        Warns of more cells turned inside out than before, where the formulation does not see them.

        Raises:
            FloatingPointError: On all ranks: a history variable would not be finite. Nothing has
                changed then.
        """
        values = [history.after_step(self, scheme) for history in self.histories]
        for history, new in zip(self.histories, values, strict=True):
            if (cell := cell_not_finite(history.field.function_space, new)) is not None:
                name = history.field.name
                raise FloatingPointError(
                    f"the history variable {name} is not finite in cell {cell} (from 0)"
                )
        for history, new in zip(self.histories, values, strict=True):
            history.field.x.array[:] = new
        scheme.advance()
        if self._inverted is not None:
            self._warn_of_inversion(self._inverted.count())

    def _warn_of_inversion(self, count: int) -> None:
        if count > self._known_inverted and self.body.mesh.comm.rank == 0:
            logger.warning(
                "%s: %d of the cells turned inside out (det F < 0), which this formulation does "
                "not see; symmetric does",
                self.form.name,
                count,
            )
        self._known_inverted = count

    def stretch(self, scheme: Scheme) -> Expr:
        """Return the right stretch at the end of a step, shape (d, d).

        That which Ψ is a function of. Where the scheme takes Ψ elsewhere, the fields beside the
        displacement are those of another point, and it is S(F).
        """
        if self._all_at_end(scheme):
            return self.form.stretch(*self.fields)
        return right_stretch(deformation_gradient(self.u))

    def stress(self, scheme: Scheme) -> Expr:
        """Return the first Piola-Kirchhoff stress [Pa] at the end of a step, shape (d, d).

        See `stretch`.
        """
        if self._all_at_end(scheme):
            return self.form.stress(*self.fields, self.psi)
        return first_piola_kirchhoff_stress(deformation_gradient(self.u), self.psi)

    def energies(self, scheme: Scheme) -> EnergyIntegrals:
        """Return what gives the energies between steps: `model.energies(scheme).now()`.

        Made once, as it compiles. Collective.
        """
        kinetic = None
        if scheme.inertial:
            kinetic = scheme.kinetic_energy(self._density(scheme)) * ufl.dx
        elastic = self.psi(self.stretch(scheme)) * measure(self.u)
        potential = total(self.potentials(self.u))
        return EnergyIntegrals(self.body.mesh.comm, (kinetic, elastic, potential))

    def _all_at_end(self, scheme: Scheme) -> bool:
        return len(self.fields) == 1 or scheme.point(self.u) is self.u

    def potentials(self, u: Expr) -> list[ufl.Form]:
        """Return the potential energies of loads [J], at a displacement u [m]."""
        terms = [load.energy(self.body, u, self.rho) for load in self.loads]
        return [term for term in terms if term is not None]

    def damping_potentials(self, scheme: Scheme) -> tuple[ufl.Form | None, ufl.Form | None]:
        """Return the potentials of damping by inertia and by stiffness [J], see `Rayleigh`."""
        of_mass, of_stiffness = None, None
        if self.damping is not None and self.damping.mass > 0.0:
            of_mass = self.damping.of_mass(scheme, self._density(scheme)) * ufl.dx
        if self.damping is not None and self._S_old is not None:
            S = self.form.stretch(scheme.point(self.u), *self.fields[1:])
            moduli = self.damping.moduli or self.psi.rest  # type: ignore[attr-defined]
            viscous = self.damping.of_stiffness(scheme, S, self._S_old, moduli)
            of_stiffness = viscous * measure(self.u)
        return of_mass, of_stiffness

    def _density(self, scheme: Scheme) -> Expr:
        if self.rho is None:
            name = type(scheme).__name__
            raise ValueError(f"{name} needs a density; give the model one: rho = ... [kg/m³]")
        return self.rho


def total(terms: Sequence[ufl.Form]) -> ufl.Form | None:
    """The sum of forms, None where there are none."""
    return sum(terms[1:], terms[0]) if terms else None


class Energies(NamedTuple):
    """Energies [J] of a whole body; 0 for what there is not."""

    kinetic: float
    elastic: float
    potential: float


class EnergyIntegrals:
    """The integrals that give the energies of a body, compiled once."""

    def __init__(self, comm: MPI.Comm, integrals: Sequence[ufl.Form | None]) -> None:
        """Compile the kinetic, elastic and potential energy. Collective."""
        self._integrals = Integrals(comm, integrals)

    def now(self) -> Energies:
        """Return the present values. Collective."""
        return Energies(*self._integrals.now())


class Integrals:
    """Integrals over the whole body, compiled once; 0 where there is no form."""

    def __init__(self, comm: MPI.Comm, forms: Sequence[ufl.Form | None]) -> None:
        """Compile them. Collective."""
        self._comm = comm
        self._forms = [form for form in forms if form is not None]
        self._compiled = compile_together(list(forms))

    def now(self) -> list[float]:
        """Return the present values. Collective."""
        refresh(self._forms)
        here = [0.0 if f is None else np.real(fem.assemble_scalar(f)) for f in self._compiled]
        return [float(value) for value in self._comm.allreduce(np.array(here))]
