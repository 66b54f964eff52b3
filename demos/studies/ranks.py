"""Python on several ranks, started from a process that is not one of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import demos


class RanksError(RuntimeError):
    """The ranks did not come to their end; the message tells what they said."""


def on_ranks(ranks: int, code: str, *arguments: str, timeout: float) -> str:
    """Run Python code on so many ranks with the `mpiexec` beside this interpreter.

    Args:
        ranks: How many.
        code: What to run; the packages of the project can be imported.
        arguments: Its `sys.argv[1:]`.
        timeout: Seconds after which all ranks are ended.

    Returns:
        What they printed.

    Raises:
        RanksError: They failed, or took longer.
    """
    command = [str(Path(sys.executable).with_name("mpiexec")), "-n", str(ranks)]
    # What this process knows of its own MPI is not for others.
    variables = {k: v for k, v in os.environ.items() if not k.startswith(("PMI_", "PMIX_"))}
    paths = [str(Path(demos.__file__).parents[1]), variables.get("PYTHONPATH", "")]
    variables |= {
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        # One thread a rank: ranks are what is counted.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    process = subprocess.Popen(
        [*command, sys.executable, "-c", code, *arguments],
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        out, err = process.communicate(timeout=timeout)
    except BaseException as error:
        process.send_signal(signal.SIGTERM)  # mpiexec ends its ranks
        try:
            process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            raise RanksError(f"{ranks} ranks were not done after {timeout:g} s") from None
        raise
    if process.returncode != 0:
        last = (err or out).strip().splitlines()[-1:]
        raise RanksError(f"{ranks} ranks failed: {' '.join(last) or process.returncode}")
    return out
