"""Where the energy of a body comes from and goes to: works, dissipation, reactions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import ufl

from forms.model import Energies, Integrals, Model, total
from forms.spaces import function
from forms.time import Scheme

Array = npt.NDArray[np.float64]


class Balance(NamedTuple):
    """Sums since the start [J]; kinetic + elastic + dissipated - loads - motions is constant.

    With the midpoint rule to second order in h, and exactly where the energy is quadratic; else to
    first order. What is missing the scheme's own damping has taken, or a history variable, such as
    plastic flow.

    Attributes:
        loads: Work of loads.
        motions: Work of reactions on held parts.
        dissipated: Energy that Rayleigh damping has taken.
    """

    loads: float = 0.0
    motions: float = 0.0
    dissipated: float = 0.0

    def missing(self, start: Energies, now: Energies) -> float:
        """Return what of the works [J] the body has not won since the start, nor damping taken."""
        gained = now.kinetic + now.elastic - start.kinetic - start.elastic
        return self.loads + self.motions - self.dissipated - gained


class Account:
    """Keep account of the steps of a model; stands before it in `solvers.march`.

        account = Account(model, scheme, problem.unbalanced_forces)
        for _ in march(problem, scheme, steps, account):
            print(account.balance, account.reactions)

    The balance of forces that a step has solved, taken where the scheme takes Ψ, is multiplied by
    the change of the displacement over the step.

    Attributes:
        balance: Works and dissipation up to now.
        reactions: The force [N] that each motion of the model exerted on the body in the last step,
            where the scheme takes Ψ; shape (motions, d), 0 along axes that are free. Where two hold
            the same point, it counts for the last.
    """

    def __init__(self, model: Model, scheme: Scheme, forces: Callable[[], Array]) -> None:
        """Compile the works. Collective.

        Args:
            model: The model.
            scheme: Of its displacement.
            forces: Gives the derivative of the model's energy less work by the displacement [N], on
                local degrees of freedom: `solvers.MixedProblem.unbalanced_forces`.
        """
        self._model, self._forces = model, forces
        u, V = model.u, model.u.function_space
        self.balance = Balance()
        self.reactions = np.zeros((len(model.held), V.dofmap.bs))
        self._change = function(V)
        u_theta = scheme.point(u)
        loads = [-ufl.derivative(term, u, self._change) for term in model.potentials(u_theta)]
        work = model.virtual_work(scheme)
        if work is not None:
            loads.append(ufl.action(work, self._change))
        of_mass, of_stiffness = model.damping_potentials(scheme)
        dissipated = [] if of_mass is None else [ufl.derivative(of_mass, u, self._change)]
        if of_stiffness is not None:
            # Quadratic in the change of the stretch, so twice is its derivative along that.
            dissipated.append(2 * of_stiffness)
        self._works = Integrals(V.mesh.comm, [total(loads), total(dissipated)])
        holder = np.full((len(u.x.array) // V.dofmap.bs, V.dofmap.bs), -1)
        for k, held in enumerate(model.held):
            holder[np.ix_(held.blocks, held.components)] = k
        self._holder = holder[: V.dofmap.index_map.size_local]

    def update(self, scheme: Scheme) -> None:
        """See `Model.update`."""
        self._model.update(scheme)

    def accept(self, scheme: Scheme) -> None:
        """Book the step, then let the model accept it, see `Model.accept`. Collective."""
        comm, owned = self._model.u.function_space.mesh.comm, self._holder.shape
        self._change.x.array[:] = self._model.u.x.array - scheme.u_old.x.array
        forces = self._forces()[: self._holder.size].reshape(owned) / scheme.theta
        change = self._change.x.array[: self._holder.size].reshape(owned)
        local = np.zeros_like(self.reactions)
        for k in range(len(local)):
            local[k] = np.where(self._holder == k, forces, 0.0).sum(axis=0)
        motions = float(np.sum(forces * change, where=self._holder >= 0))
        self.reactions = np.asarray(comm.allreduce(local))
        before, (loads, dissipated) = self.balance, self._works.now()
        self.balance = Balance(
            before.loads + loads / scheme.theta,
            before.motions + comm.allreduce(motions),
            before.dissipated + dissipated / scheme.theta,
        )
        self._model.accept(scheme)
