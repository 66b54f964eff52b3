"""The application behind `mixed-fem`: command line, scenes, runs, results, pictures."""

from __future__ import annotations

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)
