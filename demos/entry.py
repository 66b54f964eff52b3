"""Where the processes of `mixed-fem` begin: nothing long is imported before Ctrl-C is heeded."""

from __future__ import annotations

import os
import signal
import sys


def main() -> int:
    """Run the command line of this process; the exit code."""
    # An exception in the middle of an import can be swallowed, or leave MPI half begun. Here
    # nothing is to be saved or ended in order, so the process just goes.
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in usual.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _go)
    from demos.app.cli import main as run

    for number, handler in usual.items():
        signal.signal(number, handler)
    return run()


def _go(number: int, frame: object) -> None:
    print("mixed-fem: interrupted; nothing had begun", file=sys.stderr, flush=True)
    os._exit(128 + number)
