"""How a motion starts: thrown, spinning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from forms.model import Model
from forms.time import Scheme


def set_velocity(
    model: Model,
    scheme: Scheme,
    velocity: Sequence[float] | None = None,
    spin: float | Sequence[float] | None = None,
    centre: Sequence[float] | None = None,
) -> None:
    """Give a body the velocity v + ω × (x - c) at the start of a step, x = X + u. Collective.

    What a motion holds stays at rest.

    Args:
        model: The body.
        scheme: Of its displacement.
        velocity: v [m/s], d numbers.
        spin: ω [rad/s], in 2D a number, in 3D three.
        centre: c [m], d numbers; by default the centre of mass, so that v is the body's.

    Raises:
        ValueError: Another number of components.
    """
    V = scheme.u.function_space
    d = V.mesh.geometry.dim
    for name, given in (("velocity", velocity), ("centre", centre)):
        if given is not None and len(given) != d:
            raise ValueError(f"{name} has {len(given)} components; the body lives in {d}D")
    W = _turning(spin, d)
    c = _centre_of_mass(model) if centre is None else np.array(centre, dtype=float)
    x = V.tabulate_dof_coordinates()[:, :d] + scheme.u.x.array.reshape(-1, d)
    v = np.zeros(d) if velocity is None else np.array(velocity, dtype=float)
    scheme.v.x.array[:] = (v + (x - c) @ W.T).ravel()
    for bc in model.bcs:
        dofs, _ = bc.dof_indices()
        scheme.v.x.array[dofs] = 0.0


def _turning(spin: float | Sequence[float] | None, d: int) -> npt.NDArray[np.float64]:
    """The matrix W of W r = ω × r."""
    right = "a number" if d == 2 else "three numbers"
    omega = np.zeros((3, 1)[d == 2]) if spin is None else np.atleast_1d(np.array(spin, dtype=float))
    if omega.size != (3, 1)[d == 2]:
        raise ValueError(f"spin has {omega.size} components; in {d}D it must be {right}")
    if d == 2:
        return np.array([[0.0, -omega[0]], [omega[0], 0.0]])
    return np.cross(omega, np.eye(3)).T


def _centre_of_mass(model: Model) -> npt.NDArray[np.float64]:
    """∫ ρ x dX / ∫ ρ dX."""
    msh = model.body.mesh
    rho = fem.Constant(msh, 1.0) if model.rho is None else model.rho
    x = ufl.SpatialCoordinate(msh) + model.u
    terms = [rho * x[i] * ufl.dx for i in range(len(x))] + [rho * ufl.dx(msh)]
    *moments, mass = (msh.comm.allreduce(fem.assemble_scalar(fem.form(term))) for term in terms)
    return np.array(moments) / mass
