"""Lines and bars on the screen; rank 0 speaks for all."""

from __future__ import annotations

import sys
from typing import TextIO

from mpi4py import MPI

BAR = 30  # characters


class Screen:
    """Prints on rank 0: on a terminal with a bar for work under way, else in plain lines."""

    def __init__(
        self, comm: MPI.Comm, stream: TextIO | None = None, *, quiet: bool = False
    ) -> None:
        """Speak on `stream`, by default standard output, or not at all."""
        self._stream = stream if stream is not None else sys.stdout
        self._silent = quiet or comm.rank != 0
        self._terminal = self._stream.isatty()
        self._bar = ""

    def line(self, text: str = "") -> None:
        """Print a line."""
        if not self._silent:
            self._write(f"{self._erase()}{text}\n")
            self._bar = ""

    def progress(self, label: str, done: int, total: int, detail: str = "") -> None:
        """Show that `done` of `total` steps of some work are done."""
        if self._silent:
            return
        if not self._terminal:
            if done:
                self.line(f"{label} {done:>{len(str(total))}}/{total}  {detail}".rstrip())
            return
        filled = BAR * done // total
        bar = f"{label} [{'=' * filled}{' ' * (BAR - filled)}] {done}/{total}  {detail}"
        self._write(f"{self._erase()}{bar}")
        self._bar = bar
        if done == total:
            self._write("\n")
            self._bar = ""

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except BrokenPipeError:  # nobody reads it; the work goes on
            self._silent = True

    def _erase(self) -> str:
        return f"\r{' ' * len(self._bar)}\r" if self._bar else ""


def duration(seconds: float) -> str:
    """A time to wait, in words."""
    return f"about {seconds / 60:.0f} min" if seconds > 90 else f"about {seconds:.0f} s"
