"""Resident memory of this process, as Linux counts it."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

from mpi4py import MPI

from solvers.lifetime import destroy_dead


def release(comm: MPI.Comm) -> None:
    """Give back to the system what problems that are gone have left. Collective."""
    gc.collect()
    destroy_dead(comm)
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)


def forget_peak() -> None:
    """Start to measure the peak memory of this process anew, where Linux lets one."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_memory() -> float:
    """Peak resident memory of this process [GB]."""
    return _status("VmHWM")


def resident_memory() -> float:
    """Resident memory of this process at present [GB]."""
    return _status("VmRSS")


def _status(name: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1e6
    return float("nan")
