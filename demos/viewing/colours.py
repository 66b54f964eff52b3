"""The scalar fields by which a body can be coloured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

State = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Field:
    """A scalar field of a state.

    Attributes:
        label: How a colour bar calls it, with its unit.
        description: What it is.
        on: "cells" or "vertices".
        values: Of a state of `demos.viewing.Results`, shape (cells,) or (vertices,).
    """

    label: str
    description: str
    on: str
    values: Callable[[State], npt.NDArray[np.float64]]


def _strain(state: State) -> npt.NDArray[np.float64]:
    S = state["S"]
    return np.asarray(np.linalg.norm(S - np.eye(S.shape[-1]), axis=(1, 2)), dtype=np.float64)


def _stretch(state: State) -> npt.NDArray[np.float64]:
    return np.asarray(np.linalg.eigvalsh(state["S"])[:, -1], dtype=np.float64)


FIELDS = {
    "strain": Field("∣S − I∣", "Frobenius norm of S - I", "cells", _strain),
    "von-mises": Field("σ_vM [Pa]", "von Mises stress", "cells", lambda s: s["von_mises"]),
    "energy": Field("Ψ [J/m³]", "strain energy density", "cells", lambda s: s["psi"]),
    "stretch": Field("λ₁", "largest principal stretch", "cells", _stretch),
    "speed": Field("∣v∣ [m/s]", "magnitude of the velocity", "vertices", lambda s: _length(s["v"])),
    "displacement": Field(
        "∣u∣ [m]", "magnitude of the displacement", "vertices", lambda s: _length(s["x"] - s["X"])
    ),
}


def _length(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vectors, axis=1), dtype=np.float64)
