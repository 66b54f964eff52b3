"""The process that draws the results of a run: a picture, a movie, a window or a page.

It is one of its own, since VTK does not raise where a machine has no EGL but crashes, and inside a
run under MPI that would take the results with it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from demos.viewing.results import ResultsError, load
from demos.viewing.stage import Stage


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw as the arguments say; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m demos.viewing", description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--field", default="strain")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--movie", type=Path)
    parser.add_argument("--step", type=int)
    parser.add_argument("--port", type=int)
    given = parser.parse_args(arguments)
    try:
        results = load(given.results)
        if given.step is not None and not -len(results) <= given.step < len(results):
            raise ResultsError(f"--step {given.step}: the run has steps 0 to {len(results) - 1}")
        if given.picture is not None:
            step = -1 if given.step is None else given.step
            Stage(results, given.field, only=step).picture(given.picture)
        if given.movie is not None:
            Stage(results, given.field).movie(given.movie)
        if given.port is not None:
            from demos.viewing.page import serve

            serve(Stage(results, given.field), results, given.port)
        elif given.picture is None and given.movie is None:
            if sys.platform.startswith("linux") and not (
                os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            ):
                raise ResultsError("no display here; use --web, --picture FILE or --movie FILE")
            from demos.viewing.window import show

            show(Stage(results, given.field, window=True), results)
    except ResultsError as error:
        print("mixed-fem:", error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
