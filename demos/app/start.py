"""How a run starts: at rest, thrown, or in the state in which a former run has ended."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem

from forms import Model, Scheme, displacement_field, measure, set_velocity
from meshes import Body
from solvers import ConvergenceError, MixedProblem


@dataclass(frozen=True)
class Start:
    """The state at t = 0.

    Attributes:
        velocity: Velocity of the body [m/s].
        spin: Angular velocity [rad/s], in 2D a number, in 3D three.
        centre: A point [m] that the spin leaves in place; by default the centre of mass.
        result: A file final.npz of a run of the same mesh, from which positions come and, where no
            velocity and no spin is given, velocities.
    """

    velocity: Sequence[float] | None = None
    spin: float | Sequence[float] | None = None
    centre: Sequence[float] | None = None
    result: str | None = None

    def __call__(self, model: Model, scheme: Scheme, body: Body, folder: Path) -> None:
        """Put a model and its scheme there. Collective.

        Args:
            model: The model, at rest.
            scheme: The scheme.
            body: The body of the model.
            folder: What the path of `result` is relative to.

        Raises:
            ValueError: A wrong number of components, or a file that does not fit.
        """
        if self.result is not None:
            x, v = _read(body, folder / self.result)
            _put(body, model.u, x - body.gather_points(everywhere=True))
            _put(body, scheme.v, v)
            scheme.u_old.x.array[:] = model.u.x.array
            _settle(model)
            after = [history.after_step(model, scheme) for history in model.histories]
            for history, values in zip(model.histories, after, strict=True):
                history.field.x.array[:] = values
        if self.velocity is not None or self.spin is not None:
            set_velocity(model, scheme, self.velocity, self.spin, self.centre)


def _read(body: Body, path: Path) -> list[Any]:
    """Positions and velocities of all vertices, on all ranks. Collective."""
    comm = body.mesh.comm
    found: list[Any] | None = None
    wrong = ""
    X = body.gather_points()
    if X is not None:
        try:
            with np.load(path) as state:
                rest, found = state["X"], [state["x"], state["v"]]
            if rest.shape != X.shape or np.abs(rest - X).max() > 1e-9 * np.ptp(X):
                wrong = f"is of another mesh, with {len(rest)} vertices; this one has {len(X)}"
        except OSError as e:
            wrong = f"cannot be read ({e.strerror or e})"
        except (KeyError, ValueError, zipfile.BadZipFile):
            wrong = "is no final.npz of a run"
    found, wrong = comm.bcast((found, wrong))
    if wrong or found is None:
        raise ValueError(f'result = "{path}": {wrong}')
    return found


def _put(body: Body, f: fem.Function[Any], values: Any) -> None:
    """Set a Lagrange function of any degree from its values at the vertices."""
    linear = displacement_field(body.mesh)
    body.put(linear, values)
    f.interpolate(linear)


def _settle(model: Model) -> None:
    """Bring the fields beside the displacement to where they go with it. Collective."""
    if len(model.fields) == 1:
        return
    u = model.u
    held = fem.Function(u.function_space)
    held.x.array[:] = u.x.array
    blocks = np.arange(len(u.x.array) // u.function_space.dofmap.bs, dtype=np.int32)
    energy = model.form.density(*model.fields, model.psi) * measure(u)
    conditions = [fem.dirichletbc(held, blocks)]
    try:
        MixedProblem(energy, model.fields, conditions, solver="direct").solve()
    except ConvergenceError as e:
        raise ValueError(f"no stretch goes with these positions: {e.result.reason}") from e
