"""Checkpoints: all that steps change, in a file that any number of ranks can go on from.

    checkpoint.save(path, body, model, scheme, step=12)
    ...
    saved = checkpoint.read(path, comm)
    saved.put(body, model, scheme)
    step = saved.more["step"]

The file is NumPy's npz. It is written beside its place and moved there when it is whole, so that a
process that is killed leaves the former one.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from forms import Model, Scheme
from forms.spaces import function
from meshes import Body
from meshes.cellwise import gather_all, put_all
from solvers.files import write_whole

FORMAT = 1

Array = npt.NDArray[Any]


class CheckpointError(ValueError):
    """A file is no checkpoint that one can go on from; the message is one line."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds.

    Attributes:
        path: The file.
        values: Functions in file order and numbers, by name; the same on all ranks.
        more: What the program has put beside them.
    """

    path: Path
    values: Mapping[str, Array]
    more: Mapping[str, Any]

    def put(self, body: Body, model: Model, scheme: Scheme) -> None:
        """Put a model and its scheme where they were. Collective.

        Raises:
            CheckpointError: They are not of the same kind.
        """
        functions, numbers = _functions(model, scheme), _numbers(scheme)
        known = {*functions, *numbers}
        if differing := sorted(known ^ set(self.values)):
            raise CheckpointError(
                f"{self.path}: is of another formulation or scheme: only one of the two has "
                f"{differing[0]}"
            )
        for name, f in functions.items():
            try:
                put_all(body, f, self.values[name])
            except ValueError as e:
                raise CheckpointError(f"{self.path}: is of another body or degree: {e}") from e
        for name, values in _arrays(scheme).items():
            values[:] = functions[name].x.array
        for name in numbers:
            _set_number(scheme, name, self.values[name])


def save(path: Path | str, body: Body, model: Model, scheme: Scheme, **more: Any) -> None:
    """Write a checkpoint. Collective.

    Args:
        path: The file.
        body: The body.
        model: Its fields and histories.
        scheme: Its time and velocities.
        more: What else the program needs, as plain as JSON.

    Raises:
        OSError: On all ranks: the file cannot be written. A former one is left as it was.
    """
    functions = {name: gather_all(body, f) for name, f in _functions(model, scheme).items()}
    comm = body.mesh.comm
    error: OSError | None = None
    if comm.rank == 0:
        values: dict[str, Any] = {**functions, **_numbers(scheme)}
        values["about"] = np.array(json.dumps({"format": FORMAT, "more": more}))
        try:
            write_whole(Path(path), lambda place: _write(place, values))
        except OSError as e:
            error = e
    error = comm.bcast(error)
    if error is not None:
        raise error


def read(path: Path | str, comm: MPI.Comm) -> Checkpoint:
    """Read a checkpoint. Collective.

    Raises:
        CheckpointError: On all ranks: there is no such file, it is damaged, or of another version
            of this program.
    """
    found: Checkpoint | CheckpointError | None = None
    if comm.rank == 0:
        try:
            found = _read(Path(path))
        except CheckpointError as e:
            found = e
    found = comm.bcast(found)
    if isinstance(found, CheckpointError):
        raise found
    assert found is not None
    return found


def _write(path: Path, values: Mapping[str, Array]) -> None:
    with path.open("wb") as file:  # under its very name
        np.savez(file, allow_pickle=False, **values)


def _read(path: Path) -> Checkpoint:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            values = {name: data[name] for name in data.files}
        about = json.loads(str(values.pop("about")))
        version, more = about["format"], about["more"]
    except FileNotFoundError as e:
        raise CheckpointError(f"{path}: no such file") from e
    except OSError as e:
        raise CheckpointError(f"{path}: cannot be read ({e.strerror or e})") from e
    except (
        *(ValueError, KeyError, TypeError, AttributeError, EOFError, MemoryError),
        *(zipfile.BadZipFile, zlib.error, NotImplementedError, OverflowError, RuntimeError),
    ) as e:
        raise CheckpointError(f"{path}: no checkpoint, or truncated or damaged") from e
    if version != FORMAT:
        raise CheckpointError(
            f"{path}: written in format {version}; this version of mixed-fem reads {FORMAT}"
        )
    if wrong := [name for name, value in values.items() if value.dtype.kind not in "fi"]:
        raise CheckpointError(f"{path}: no checkpoint, or damaged: {wrong[0]} is no number")
    if wrong := [name for name, value in values.items() if not np.isfinite(value).all()]:
        raise CheckpointError(f"{path}: {wrong[0]} is not finite everywhere")
    return Checkpoint(path, values, more)


def _functions(model: Model, scheme: Scheme) -> dict[str, fem.Function[Any]]:
    """All that a step changes and that is a function, by name."""
    found = {f"field {f.name}": f for f in model.fields}
    for k, history in enumerate(model.histories):
        found[f"history {k} {history.field.name}"] = history.field
    for name, value in vars(scheme).items():
        if isinstance(value, fem.Function) and value is not scheme.u:
            found[f"scheme {name}"] = value
    for name, values in _arrays(scheme).items():
        found[name] = function(scheme.u.function_space)
        found[name].x.array[:] = values
    return found


def _arrays(scheme: Scheme) -> dict[str, Array]:
    """All that a step changes and that is an array of degrees of freedom, by name."""
    size = scheme.u.x.array.shape
    return {
        f"scheme {name}": value
        for name, value in vars(scheme).items()
        if isinstance(value, np.ndarray) and value.shape == size
    }


def _numbers(scheme: Scheme) -> dict[str, Array]:
    """All that a step changes and that is a number, by name."""
    found: dict[str, Array] = {}
    for name, value in vars(scheme).items():
        if isinstance(value, fem.Constant):
            found[f"scheme {name}"] = np.array(value.value)
        elif isinstance(value, int | float):
            found[f"scheme {name}"] = np.array(float(value))
    return found


def _set_number(scheme: Scheme, name: str, value: Array) -> None:
    attribute = name.removeprefix("scheme ")
    present = getattr(scheme, attribute)
    if isinstance(present, fem.Constant):
        present.value[...] = value.reshape(present.value.shape)
    else:
        setattr(scheme, attribute, type(present)(value.item()))
