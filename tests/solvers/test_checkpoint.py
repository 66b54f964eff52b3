"""Checkpoints: the same motion afterwards, on any ranks, and damaged ones are refused."""

from __future__ import annotations

import os
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from forms import (
    FORMULATIONS,
    SCHEMES,
    Fixed,
    Gravity,
    Model,
    Rayleigh,
    StableNeoHookean,
    displacement_field,
    mixed_fields,
)
from meshes import Where, box
from meshes.cellwise import gather_all, put_all
from solvers import CheckpointError, MixedProblem, checkpoint, march
from tests.bodies import largest
from tests.states import random_values

COMM = MPI.COMM_WORLD
LEFT = Where(extents=(("x", "min"),))


class Bar:
    """A damped bar that falls."""

    def __init__(self, scheme, formulation, comm=COMM, cell="triangle", degree=1):
        self.body = box(comm, (2.0, 1.0), (4, 2), cell)
        self.model = Model(
            self.body,
            formulation,
            StableNeoHookean(1e4, 0.3),
            rho=1000.0,
            loads=[Gravity((0.0, -9.81))],
            motions=[Fixed(LEFT)],
            damping=Rayleigh(0.1, 0.01),
            degree=degree,
        )
        self.scheme = SCHEMES[scheme](self.model.u, 0.1)
        self.problem = MixedProblem(
            self.model.energy(self.scheme), self.model.fields, self.model.bcs
        )

    def march(self, steps):
        list(march(self.problem, self.scheme, steps, self.model))

    def state(self):
        return {name: gather_all(self.body, f) for name, f in self.functions().items()}

    def functions(self):
        return {"u": self.model.u, "v": self.scheme.v, "S": self.model.histories[0].field}


def path_of(tmp_path):
    return Path(COMM.bcast(str(tmp_path))) / "a.npz"


@pytest.mark.parametrize("scheme", [name for name in SCHEMES if SCHEMES[name].inertial])
def test_every_scheme_goes_on(scheme, tmp_path):
    """To the last bit on one rank."""
    whole, first, second = (Bar(scheme, "symmetric") for _ in range(3))
    whole.march(6)
    first.march(3)
    path = path_of(tmp_path)
    checkpoint.save(
        path, first.body, first.model, first.scheme, carried=first.problem.carried(), step=3
    )
    saved = checkpoint.read(path, COMM)
    assert saved.more["step"] == 3
    saved.put(second.body, second.model, second.scheme)
    second.problem.carry(saved.more["carried"])
    assert second.scheme.t == first.scheme.t
    second.march(3)
    assert second.scheme.t == whole.scheme.t
    for name, f in second.functions().items():
        other = whole.functions()[name].x.array
        assert largest(other) > 1e-3
        assert largest(f.x.array - other) <= (0.0 if COMM.size == 1 else 1e-10)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_every_formulation_goes_on(formulation, tmp_path):
    cell, degree = ("triangle", 1) if formulation == "taylor-hood" else ("quadrilateral", 2)
    whole, first, second = (Bar("bdf2", formulation, cell=cell, degree=degree) for _ in range(3))
    whole.march(4)
    first.march(2)
    path = path_of(tmp_path)
    checkpoint.save(path, first.body, first.model, first.scheme)
    checkpoint.read(path, COMM).put(second.body, second.model, second.scheme)
    second.march(2)
    assert largest(second.model.u.x.array - whole.model.u.x.array) < 1e-9


@pytest.mark.mpi
@pytest.mark.parametrize("to_more", [True, False])
def test_other_numbers_of_ranks(to_more, tmp_path):
    """Written alone and read by all, or written by all and read alone."""
    path = path_of(tmp_path)
    comms = (MPI.COMM_SELF, COMM) if to_more else (COMM, MPI.COMM_SELF)
    first, second = (
        Bar("generalised-alpha", "symmetric", comm, "quadrilateral", 2) for comm in comms
    )
    first.march(2)
    if first.body.mesh.comm.size > 1 or COMM.rank == 0:
        checkpoint.save(path, first.body, first.model, first.scheme)
    COMM.barrier()
    checkpoint.read(path, comms[1]).put(second.body, second.model, second.scheme)
    for bar in (first, second):
        bar.march(2)
    one, other = first.state(), second.state()
    if COMM.rank == 0:
        for name, values in one.items():
            np.testing.assert_allclose(other[name], values, atol=1e-9 * np.abs(values).max())


@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 1), ("triangle", 3), ("quadrilateral", 2), ("hexahedron", 2)]
)
def test_functions_of_any_kind_come_back(cell, degree):
    size, cells = ((1.0,) * 3, (2, 2, 2)) if cell == "hexahedron" else ((1.0,) * 2, (3, 2))
    body = box(COMM, size, cells, cell)
    for f in (displacement_field(body.mesh, degree), *mixed_fields(body.mesh, degree=degree)):
        f.x.array[:] = random_values(f, 1)
        f.x.scatter_forward()
        before = f.x.array.copy()
        values = COMM.bcast(gather_all(body, f))
        f.x.array[:] = np.nan
        put_all(body, f, values)
        np.testing.assert_array_equal(f.x.array, before)
        with pytest.raises(ValueError, match="are given for"):
            put_all(body, f, values[:-1])


@pytest.fixture(scope="module")
def bar():
    return Bar("backward-euler", "symmetric")


def test_of_another_body_formulation_or_scheme(bar, tmp_path):
    path = path_of(tmp_path)
    checkpoint.save(path, bar.body, bar.model, bar.scheme)
    saved = checkpoint.read(path, COMM)
    for other, message in (
        (Bar("backward-euler", "displacement"), "another formulation or scheme"),
        (Bar("bdf2", "symmetric"), "another formulation or scheme: only one of the two has scheme"),
        (Bar("backward-euler", "symmetric", cell="quadrilateral"), "another body or degree"),
    ):
        with pytest.raises(CheckpointError, match=message):
            saved.put(other.body, other.model, other.scheme)


def test_no_such_file(tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing\.npz: no such file"):
        checkpoint.read(tmp_path / "nothing.npz", COMM)


@pytest.mark.serial
def test_another_version(bar, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 7)
    checkpoint.save(tmp_path / "a.npz", bar.body, bar.model, bar.scheme)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match=r"written in format 7; this version .* reads 1"):
        checkpoint.read(tmp_path / "a.npz", COMM)


@pytest.mark.serial
def test_no_number_is_refused(bar, tmp_path):
    bar.scheme.v.x.array[3] = np.inf
    checkpoint.save(tmp_path / "a.npz", bar.body, bar.model, bar.scheme)
    bar.scheme.v.x.array[3] = 0.0
    with pytest.raises(CheckpointError, match="scheme v is not finite"):
        checkpoint.read(tmp_path / "a.npz", COMM)


@pytest.mark.serial
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_in_one_line(bar, tmp_path, data):
    """Cut short, or with bytes changed: read as it was, or refused."""
    path = tmp_path / "a.npz"
    checkpoint.save(path, bar.body, bar.model, bar.scheme, step=1)
    whole = path.read_bytes()
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            place = data.draw(st.integers(0, len(damaged) - 1))
            damaged[place] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged)
    try:
        saved = checkpoint.read(path, COMM)
        saved.put(bar.body, bar.model, bar.scheme)
    except CheckpointError as error:
        assert "\n" not in str(error)
        assert str(path) in str(error)


@pytest.mark.serial
def test_a_full_disk_leaves_the_former_one(bar, tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    checkpoint.save(path, bar.body, bar.model, bar.scheme, step=1)

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(path, bar.body, bar.model, bar.scheme, step=2)
    monkeypatch.undo()
    assert checkpoint.read(path, COMM).more["step"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
