"""PETSc's objects: destroyed on all ranks together, and thrifty with communicators.

They are destroyed some time after Python lets go of their owner. Destroying one is collective, and
Python's garbage collector runs when it likes on each rank. Left to PETSc's own delayed destruction
they would stay for good, with a communicator each, of which MPICH has 2048.
"""

from __future__ import annotations

import gc
import itertools
import weakref
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

_Group = tuple[int, ...]  # ranks of COMM_WORLD

_serial = itertools.count()
_dead: dict[tuple[_Group, int], Sequence[Any]] = {}
_shared: list[MPI.Comm] = [MPI.COMM_WORLD, MPI.COMM_SELF]
_factors: dict[tuple[_Group, int], weakref.ref[Any]] = {}

MOST_FACTORS = 32
"""Of so many solvers factors are kept. Those of MUMPS have four communicators each."""

SPARE = 64
"""So many communicators a new problem must find: more than its mesh, fields and solver take."""


def require_communicators(comm: MPI.Comm) -> None:
    """Insist on communicators for another problem: without them MPI would abort. Collective.

    Raises:
        RuntimeError: There are too few, even without the problems that nobody needs any more.
    """
    shared = shared_communicator(comm)
    destroy_dead(shared)
    if _spare(shared):
        return
    gc.collect()
    destroy_dead(shared)
    if not _spare(shared):
        raise RuntimeError(
            f"MPI has fewer than {SPARE} communicators left for another problem; let go of some of "
            "the problems and meshes in memory, or have problems share a mesh"
        )


def _spare(comm: MPI.Comm) -> bool:
    handler = comm.Get_errhandler()
    comm.Set_errhandler(MPI.ERRORS_RETURN)
    made: list[MPI.Comm] = []
    try:
        made.extend(comm.Dup() for _ in range(SPARE))
    except MPI.Exception:
        pass
    finally:
        comm.Set_errhandler(handler)
        for spare in made:
            spare.Free()
    return len(made) == SPARE


def shared_communicator(comm: MPI.Comm) -> MPI.Comm:
    """One communicator of the same ranks for all of PETSc's objects. Collective.

    DOLFINx gives each mesh and each index map one of its own, and PETSc makes another of each.
    """
    for known in _shared:
        if MPI.Comm.Compare(comm, known) in (MPI.IDENT, MPI.CONGRUENT):
            return known
    _shared.append(comm.Dup())
    return _shared[-1]


class Factors:
    """The right to keep factors, which the solvers lose that have not solved for the longest."""

    def __init__(self, comm: MPI.Comm, owner: Any) -> None:
        """Claim nothing yet.

        Args:
            comm: Communicator of the owner.
            owner: A solver with a method `renew`, collective, that lets go of its factors.
        """
        self._comm, self._owner = shared_communicator(comm), weakref.ref(owner)
        self._group = _group(comm)
        self._key: tuple[_Group, int] | None = None

    def used(self) -> None:
        """Say that the factors have been used just now. Collective."""
        if self._key is not None:
            _factors.pop(self._key, None)
        self._key = self._group, next(_serial)
        _factors[self._key] = self._owner
        here = {s: r for (group, s), r in _factors.items() if group == self._group}
        if not self._comm.allreduce(len(here) > MOST_FACTORS, MPI.LOR):
            return
        alive = {s: owner for s, r in here.items() if (owner := r()) is not None}
        common = sorted(set.intersection(*self._comm.allgather(set(alive))))
        for serial in common[:-MOST_FACTORS]:
            alive[serial].renew()
        for serial in here.keys() - set(common[-MOST_FACTORS:]):
            del _factors[self._group, serial]


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
