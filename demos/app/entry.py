"""Where the processes of `mixed-fem` begin: nothing long is imported before Ctrl-C is heeded."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Run the command line of this process; the exit code."""
    try:
        from demos.app.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("mixed-fem: interrupted; nothing had begun", file=sys.stderr, flush=True)
        os._exit(130)  # half of a library may be there, which the usual way out would stumble over
