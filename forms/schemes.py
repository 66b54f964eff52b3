"""The registry of time schemes."""

from __future__ import annotations

from forms.newmark import GeneralisedAlpha, Newmark, Trapezoidal
from forms.time import BDF2, BackwardEuler, ImplicitMidpoint, Scheme, Static

SCHEMES: dict[str, type[Scheme]] = {
    "backward-euler": BackwardEuler,
    "implicit-midpoint": ImplicitMidpoint,
    "bdf2": BDF2,
    "trapezoidal": Trapezoidal,
    "newmark": Newmark,
    "generalised-alpha": GeneralisedAlpha,
    "static": Static,
}
"""Time schemes by the name that a scene file uses. To add one: `SCHEMES["mine"] = Mine`."""
