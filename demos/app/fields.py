"""A series of VTK files with the fields of each step, for ParaView, pyvista and meshio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
import numpy.typing as npt

from demos.app.files import on_rank_0
from demos.viewing import FIELDS
from demos.viewing.results import LABELS, padded
from solvers.files import write_whole

Array = npt.NDArray[np.float64]

_KINDS = {(2, 3): "triangle", (2, 4): "quad", (3, 4): "tetra", (3, 8): "hexahedron"}


class Series:
    """``fields.pvd`` and the files that it lists, a state each.

    Attributes:
        times: Of the states [s].
    """

    def __init__(self, comm: MPI.Comm, folder: Path, times: Sequence[float] = ()) -> None:
        """Begin a series, or go on with one.

        Args:
            comm: Communicator.
            folder: Where to write.
            times: Of the states that are there already; later ones are removed.
        """
        self._comm, self._folder = comm, folder
        self.times = list(times)
        on_rank_0(comm, folder, self._remove_later)

    def write(self, state: Mapping[str, Array] | None, t: float) -> None:
        """Write a state. Collective.

        Args:
            state: On rank 0, see `demos.app.output.final_state`.
            t: Its time [s].
        """
        self.times.append(t)

        def write() -> None:
            assert state is not None
            file = self._folder / _name(len(self.times) - 1)
            write_whole(file, lambda path: meshio.write(path, as_mesh(state), compression=None))
            write_whole(self._folder / "fields.pvd", lambda path: path.write_text(self._listing()))

        on_rank_0(self._comm, self._folder, write)

    def _listing(self) -> str:
        rows = [
            f'    <DataSet timestep="{t!r}" part="0" file="{_name(k)}" />'
            for k, t in enumerate(self.times)
        ]
        head = [
            '<?xml version="1.0"?>',
            '<VTKFile type="Collection" version="1.0">',
            "  <Collection>",
        ]
        return "\n".join([*head, *rows, "  </Collection>", "</VTKFile>", ""])

    def _remove_later(self) -> None:
        kept = {_name(k) for k in range(len(self.times))}
        for path in self._folder.glob("fields*.*vt[ud]"):
            if path.name not in kept:
                path.unlink(missing_ok=True)


def as_mesh(state: Mapping[str, Array]) -> meshio.Mesh:
    """A gathered state as meshio has it: present positions, with what there is on them."""
    d = state["X"].shape[1]
    at_vertices = {"u": padded(state["x"] - state["X"])}
    if "v" in state:
        at_vertices["v"] = padded(state["v"])
    on_cells = {"|S - I|": [FIELDS["strain"].values(state)]}
    for name, label in LABELS.items():
        values = state.get("Lam" if name == "P" else name)
        if values is not None:
            tensors = values.ndim == 3
            on_cells[label] = [
                padded(values).reshape(-1, 9).astype(np.float32) if tensors else values
            ]
    kind = _KINDS[d, state["cells"].shape[1]]
    return meshio.Mesh(padded(state["x"]), [(kind, state["cells"])], at_vertices, on_cells)


def _name(k: int) -> str:
    return f"fields{k:06d}.vtu"
