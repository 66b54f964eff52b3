"""Compiled libraries, kept on disk for the processor they were compiled for.

A library is written under a name of its own and renamed when it is whole: a process that is stopped
leaves no lock behind, and two that compile the same do each other no harm.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import platform
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

import cffi
import ffcx.codegeneration
from dolfinx.jit import DOLFINX_DEFAULT_JIT_OPTIONS, get_options

from forms.compilation import CompilationError, compiler, no_cache, no_compiler
from solvers.engine.source import Source

logger = logging.getLogger("mixed_fem")

# Not -ffinite-math-only: that there are no infinities and no NaN is for the solver to see.
FLAGS = "-O3 -march=native -fno-math-errno -fno-trapping-math -g0 -w".split()

_ffi = cffi.FFI()
_ffi.cdef("""
typedef struct {
  int cells;
  const int *numbers;
  const double *geometry, *basis, *data, *constants;
  double *kept, *steps;
  const int *const *dofs;
  double *const *values;
} Part;
double energy(const Part *part);
void residual(const Part *part, double *const *r);
int matrix(const Part *part, int projection, const signed char *marks, double *const *b,
           double *const *K, const int *const *places, double *const *g, double *const *lift,
           double *squares, double *singular);
void recover(const Part *part, double *const *changes);
int relax(const Part *part, int most);
int hold(const Part *part, double *const *before, int most);
""")


def load(comm: MPI.Comm, source: Source) -> tuple[Any, cffi.FFI]:
    """Compile the source, or find what it has been compiled to before. Collective.

    Raises:
        CompilationError: On all ranks: there is no compiler, it failed, or there is no cache.
    """
    key = hashlib.sha256(f"{source.key}{compiler()}{_flags()}{_processor()}".encode()).hexdigest()[
        :32
    ]
    path = Path(str(get_options()["cache_dir"])).expanduser() / f"mixed_fem_{key}.so"
    # Of ranks with processors of one kind the first compiles.
    missing = comm.allgather("" if path.exists() else key)
    error = ""
    if missing[comm.rank] and missing.index(key) == comm.rank:
        try:
            _compile(source, path)
        except CompilationError as e:
            error = str(e)
    if failed := next(filter(None, comm.allgather(error)), ""):
        raise CompilationError(failed)
    return _opened(path), _ffi


@functools.cache
def _opened(path: Path) -> Any:
    """The library, opened once: nothing is ever freed of one."""
    return _ffi.dlopen(str(path))


def _compile(source: Source, path: Path) -> None:
    logger.info("compiling the energy density (kept on disk afterwards)")
    start = time.perf_counter()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix="mixed_fem_") as folder:
            code, library = Path(folder) / "point.c", Path(folder) / "point.so"
            code.write_text(source.text(), "utf-8")
            _call_compiler(code, library)
            os.replace(library, path)
    except OSError as e:
        raise no_cache(path.parent, e) from e
    logger.info("compiled in %.1f s", time.perf_counter() - start)


def _call_compiler(code: Path, library: Path) -> None:
    include = f"-I{ffcx.codegeneration.get_include_path()}"
    command = [*compiler(), *_flags(), "-shared", "-fPIC", include, str(code), "-o", str(library)]
    try:
        subprocess.run([*command, "-lm"], check=True, capture_output=True, text=True)
    except (OSError, subprocess.SubprocessError) as e:
        raise no_compiler(_in_a_line(e)) from e


def _in_a_line(error: Exception) -> str:
    """What a compiler has to say: its first error, or else how it ended."""
    if not isinstance(error, subprocess.CalledProcessError):
        return str(error)
    said = error.stderr.strip().splitlines() or [f"exit code {error.returncode}"]
    return next((line for line in said if "error" in line), said[0])


def _flags() -> list[str]:
    """Those of the engine, then what the user gives DOLFINx, which has the last word."""
    option = "cffi_extra_compile_args"
    given = get_options()[option]
    return [*FLAGS, *([] if given == DOLFINX_DEFAULT_JIT_OPTIONS[option][0] else given)]


@functools.cache
def _processor() -> str:
    """Name and features of the processor, which a home folder may share with others."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return "\n".join(line for line in lines if line.startswith(("model name", "flags", "Features")))
