"""Starting the process that draws, see `demos.viewing.__main__`."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

TIMEOUT = 120  # [s]


def draw(folder: Path, picture: Path) -> str | None:
    """Draw the last state of a run.

    Args:
        folder: With the results of the run.
        picture: The PNG to write.

    Returns:
        None, or in one line why this machine could not draw.
    """
    try:
        done = subprocess.run(
            _command([str(folder), "--picture", str(picture)]),
            env=_environment(), capture_output=True, text=True, timeout=TIMEOUT, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"drawing took longer than {TIMEOUT} s"
    return _why(done.returncode, done.stderr)


def view(arguments: Sequence[str]) -> tuple[int, str]:
    """Look at results as the arguments say, until the user has seen enough.

    Returns:
        An exit code, and in one line what went wrong, or nothing.
    """
    done = subprocess.run(
        _command(arguments), env=_environment(), stderr=subprocess.PIPE, text=True, check=False
    )
    if done.returncode == 2:
        return 2, done.stderr.strip().removeprefix("mixed-fem: ")
    why = _why(done.returncode, done.stderr)
    return (0, "") if why is None else (2, f"view: {why}")


def _command(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-P", "-m", "demos.viewing", *arguments]


def _environment() -> dict[str, str]:
    """That of this process, in which the new one does not take itself for a rank of a run."""
    launcher = ("PMI", "PMIX", "MPI", "HYD", "OMPI")
    kept = {k: v for k, v in os.environ.items() if not k.startswith(launcher)}
    here = str(Path(__file__).parents[2])
    return kept | {"PYTHONPATH": os.pathsep.join(filter(None, [kept.get("PYTHONPATH"), here]))}


def _why(code: int, said: str) -> str | None:
    if code == 0:
        return None
    if missing := [line for line in said.splitlines() if "No module named" in line]:
        return f"{missing[-1].split()[-1].strip(chr(39))} is not installed"
    if code < 0:
        return f"VTK cannot render here, it died of signal {-code}; is libEGL installed?"
    lines = said.strip().splitlines()
    return lines[-1] if lines else f"drawing ended with exit code {code}"
