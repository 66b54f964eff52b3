"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Have a file written beside its place, then put it there: a former one stays until then.

    Args:
        path: The file.
        write: Writes to the path that it is given, which has the same suffix.
    """
    partial = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        write(partial)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
