"""Runs, scenes, pictures and the command line `mixed-fem`."""

from __future__ import annotations

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)
