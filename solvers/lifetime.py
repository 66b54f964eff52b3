"""PETSc's objects are destroyed on all ranks together, whenever Python lets go of their owner.

Destroying one is collective, and Python's garbage collector runs when it likes on each rank. Left
to PETSc's own delayed destruction they would stay for good, with a communicator each, of which
MPICH has 2048.
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

_Group = tuple[int, ...]  # ranks of COMM_WORLD

_serial = itertools.count()
_dead: dict[tuple[_Group, int], Sequence[Any]] = {}


def destroy_with(owner: object, comm: MPI.Comm, belongings: Sequence[Any]) -> None:
    """Have objects destroyed some time after their owner is gone. Collective.

    Args:
        owner: Who needs them; they must not refer to it.
        comm: Their communicator.
        belongings: In the order of destruction, by their method `destroy` or, DOLFINx's problems,
            when they are deleted.
    """
    key = _group(comm), next(_serial)
    weakref.finalize(owner, _dead.__setitem__, key, belongings).atexit = False


def destroy_dead(comm: MPI.Comm) -> None:
    """Destroy what has lost its owner on every rank. Collective."""
    group = _group(comm)
    here = {serial for where, serial in _dead if where == group}
    for serial in sorted(set.intersection(*comm.allgather(here))):
        for thing in _dead.pop((group, serial)):
            if hasattr(thing, "destroy"):
                thing.destroy()


def weakly[**P, T](method: Callable[P, T]) -> Callable[P, T]:
    """A function that calls a bound method without keeping its object alive."""
    reference = weakref.WeakMethod(method)

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = reference()
        assert bound is not None
        return bound(*args, **kwargs)

    return call


def _group(comm: MPI.Comm) -> _Group:
    members = comm.Get_group()
    ranks = MPI.Group.Translate_ranks(members, None, MPI.COMM_WORLD.Get_group())
    return tuple(int(rank) for rank in ranks)
