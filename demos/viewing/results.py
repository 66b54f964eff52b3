"""The results of a run, read back from its folder."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import meshio.vtu
import numpy as np
import numpy.typing as npt

from demos.viewing.colours import FIELDS, State

if TYPE_CHECKING:
    import pandas as pd

Array = npt.NDArray[Any]

LABELS = {
    "S": "S",
    "R": "R",
    "P": "P",
    "von_mises": "von Mises stress",
    "psi": "strain energy density",
    "tags": "tag",
}
"""What the files call the cells' fields of a state."""


class ResultsError(ValueError):
    """A folder has no results that can be read; the message is one line."""


class Results:
    """What `mixed-fem run` has written to a folder.

    Indexing gives states: `results[-1]` is a dict of arrays, the last state written, with `X` and
    `x`, rest and present positions [m], and `v`, velocity [m/s], of shape (vertices, d); `S`, right
    stretch, `R`, rotation, and `P`, first Piola-Kirchhoff stress [Pa], of shape (cells, d, d);
    `von_mises` [Pa], `psi`, strain energy density [J/m³], and `tags`, of shape (cells,); `cells`,
    vertex numbers; `t`, the time [s]. In a notebook the results show themselves.

    Attributes:
        folder: Where they are.
        about: What was run, and by what: the contents of ``run.json``.
        times: Of the states [s], shape (states,).
    """

    def __init__(self, folder: str | Path) -> None:
        """Read what there is; states are read when they are asked for.

        Args:
            folder: That a run has written to.

        Raises:
            ResultsError: There are no results in the folder.
        """
        self.folder = Path(folder)
        self.about = _about(self.folder)
        files, times = _listing(self.folder / "fields" / "fields.pvd")
        self._files = files
        self.times = np.array(times)

    def __len__(self) -> int:
        """How many states there are, that at the start included."""
        return len(self._files)

    def __iter__(self) -> Iterator[dict[str, Array]]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> dict[str, Array]:
        """A state, see the class.

        Raises:
            IndexError: There is no such state.
            ResultsError: Its file cannot be read.
        """
        path = self._files[k]
        try:
            file = meshio.vtu.read(path)
        except Exception as e:  # of an XML parser, a decoder, NumPy or meshio
            raise ResultsError(f"{path}: cannot be read ({str(e) or type(e).__name__})") from e
        (block,) = file.cells
        d = {"triangle": 2, "quad": 2}.get(block.type, 3)
        x, u = file.points[:, :d], file.point_data["u"][:, :d]
        state = {"X": x - u, "x": x, "cells": block.data, "t": self.times[k]}
        if "v" in file.point_data:
            state["v"] = file.point_data["v"][:, :d]
        for name, label in LABELS.items():
            if label in file.cell_data:
                values = file.cell_data[label][0]
                tensors = values.ndim == 2 and values.shape[1] == 9
                state[name] = values.reshape(-1, 3, 3)[:, :d, :d] if tensors else values
        return state

    def field(self, name: str, k: int = -1) -> npt.NDArray[np.float64]:
        """A scalar field of a state.

        Args:
            name: One of `FIELDS`.
            k: Number of the state.

        Raises:
            ResultsError: There is no such field, or the run has not written it.
        """
        return self.field_of(self[k], name)

    def field_of(self, state: State, name: str) -> npt.NDArray[np.float64]:
        """A scalar field of a state that has been read, see `field`."""
        if name not in FIELDS:
            raise ResultsError(f"field {name}: unknown; available: {', '.join(FIELDS)}")
        try:
            return FIELDS[name].values(state)
        except KeyError as e:
            raise ResultsError(f"{self.folder}: has no {name}; run the scene again") from e

    @property
    def name(self) -> str:
        """That of the scene."""
        return str(self.about.get("name", self.about.get("file", "")))

    @cached_property
    def history(self) -> pd.DataFrame:
        """A row a step: iterations, residuals, energies, works, reactions, seconds."""
        return _table(self.folder / "history.csv")

    @cached_property
    def newton(self) -> pd.DataFrame:
        """A row a Newton iteration, iteration 0 being the starting point of its step."""
        return _table(self.folder / "newton.csv")

    def summary(self) -> dict[str, str]:
        """What was run and what came out, in a few words each."""
        history, first = self.history, self[0]
        told = {
            "scene": self.name,
            "body": f"{len(first['cells'])} cells, {len(first['X'])} vertices",
            "formulation": str(self.about.get("formulation", "")),
            "steps": f"{len(history)}, to t = {self.times[-1]:.4g} s",
        }
        if len(history):
            newton = history["newton_iterations"]
            told["Newton iterations"] = (
                f"{newton.sum()}; {newton.median():g} a step, {newton.max()} at most"
            )
            last = history.iloc[-1]
            for name in ("kinetic_energy", "elastic_energy", "potential_energy"):
                told[name.replace("_", " ")] = f"{last[name]:.6g} J"
        return told

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(key)}</th>"
            f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
            for key, value in self.summary().items()
        )
        picture = self.folder / "picture.png"
        shown = ""
        if picture.exists():
            data = base64.b64encode(picture.read_bytes()).decode("ascii")
            shown = f"<img alt='the last state' width='640' src='data:image/png;base64,{data}'>"
        return f"<table>{rows}</table>{shown}"


def load(folder: str | Path) -> Results:
    """The results of a run, for example `load("results/hanging-bar")`.

    Args:
        folder: That `mixed-fem run` has written to.

    Raises:
        ResultsError: There are no results in the folder.
    """
    return Results(folder)


def padded(values: Array) -> Array:
    """Vectors or tensors in 3D, shape (n, 3) or (n, 3, 3)."""
    return np.pad(values, [(0, 0), *[(0, 3 - n) for n in values.shape[1:]]])


def _about(folder: Path) -> dict[str, Any]:
    path = folder / "run.json"
    try:
        about = json.loads(path.read_text("utf-8"))
    except OSError as e:
        raise ResultsError(
            f"{folder}: has no results of mixed-fem run, as {path.name} cannot be read "
            f"({e.strerror or e})"
        ) from e
    except ValueError as e:
        raise ResultsError(f"{path}: is no JSON ({e})") from e
    if not isinstance(about, dict) or about.get("program") != "mixed-fem":
        raise ResultsError(f"{path}: was not written by mixed-fem")
    return about


def _listing(path: Path) -> tuple[list[Path], list[float]]:
    """Files and times of a collection of VTK files."""
    try:
        entries = ET.parse(path).getroot().iter("DataSet")
        found = [(path.parent / e.attrib["file"], float(e.attrib["timestep"])) for e in entries]
    except OSError as e:
        raise ResultsError(f"{path}: cannot be read ({e.strerror or e})") from e
    except (ET.ParseError, KeyError, ValueError) as e:
        raise ResultsError(f"{path}: is no collection of VTK files ({e})") from e
    if not found:
        raise ResultsError(f"{path}: lists no states")
    return [file for file, _ in found], [t for _, t in found]


def _table(path: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        return pd.read_csv(path)
    except OSError as e:
        raise ResultsError(f"{path}: cannot be read ({e.strerror or e})") from e
    except ValueError as e:
        raise ResultsError(f"{path}: is no table ({e})") from e
