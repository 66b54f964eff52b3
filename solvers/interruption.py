"""Interrupts and errors in the middle of PETSc: kept until it has returned.

An exception that leaves a callback makes PETSc stop where it stands, with vectors locked and
matrices half assembled, and a later solve fails on these. So while PETSc is at work no signal
handler of Python runs; what a callback raises is kept; the iteration ends at once by PETSc's own
means; and then it is raised.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

from solvers.lifetime import weakly

_Handler = Callable[[int, Any], Any]

_depth = 0
_handlers: dict[int, _Handler] = {}
_waiting: list[int] = []


@contextmanager
def deferred() -> Iterator[None]:
    """Keep Python's signal handlers waiting until a `safe_point`, or the end. Not collective.

    May be nested: the outermost one counts. Only the main thread gets signals; in others this does
    nothing.
    """
    global _depth
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    if _depth == 0:
        _replace_handlers()
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        if _depth == 0:
            _restore_handlers()
            _run_waiting()


def safe_point(comm: MPI.Comm) -> None:
    """Run the handlers of signals that have come on any rank. Collective.

    Raises:
        BaseException: What a handler raises, on its rank; on the others the same kind. It has the
            attribute `on_all_ranks`.
    """
    if not comm.allreduce(len(_waiting)):
        return
    raised: BaseException | None = None
    try:
        _run_waiting()
    except BaseException as error:
        raised = error
    kinds = [kind for kind in comm.allgather(raised and type(raised)) if kind is not None]
    if kinds:
        told: Any = raised or kinds[0]()
        told.on_all_ranks = True
        raise told


class Guard:
    """Keeps what callbacks of a solver raise.

    On several ranks what a callback raises is let through: the others wait for this one, and there
    is no going on.

    Attributes:
        raised: The first exception since `begin`, or None.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        """Nothing has been raised."""
        self._comm = comm
        self.raised: BaseException | None = None

    def begin(self) -> None:
        """Forget."""
        self.raised = None

    def watch(self) -> bool:
        """Whether the solver is to end, as something has been raised. Collective."""
        if self.raised is None:
            try:
                safe_point(self._comm)
            except BaseException as error:
                self.raised = error
        return self.raised is not None

    def end(self) -> None:
        """Raise what has been kept."""
        raised, self.raised = self.raised, None
        if raised is not None:
            raise raised

    def callback(
        self, method: Callable[..., Any], instead: Callable[..., Any] = lambda *_: False
    ) -> Callable[..., Any]:
        """What PETSc can call: a method whose object it does not keep alive, see `protects`."""
        return self.protects(weakly(method), instead)

    def protects[**P](
        self, callback: Callable[P, Any], instead: Callable[P, Any]
    ) -> Callable[P, Any]:
        """A callback that never raises.

        Args:
            callback: What PETSc calls.
            instead: What is done in its place from the exception on.
        """

        def guarded(*args: P.args, **kwargs: P.kwargs) -> Any:
            if self.raised is None:
                try:
                    return callback(*args, **kwargs)
                except BaseException as error:
                    if self._comm.size > 1:
                        raise
                    self.raised = error
            return instead(*args, **kwargs)

        return guarded


def _replace_handlers() -> None:
    _handlers.clear()
    for number in signal.valid_signals():
        handler = signal.getsignal(number)
        if callable(handler):
            _handlers[number] = handler
            signal.signal(number, _wait)


def _restore_handlers() -> None:
    for number, handler in _handlers.items():
        if signal.getsignal(number) is _wait:  # else a callback has put its own
            signal.signal(number, handler)


def _wait(number: int, frame: object) -> None:
    _waiting.append(number)


def _run_waiting() -> None:
    while _waiting:
        number = _waiting.pop(0)
        _handlers[number](number, None)
