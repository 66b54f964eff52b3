"""Forms compiled together; and what can go wrong: no compiler, no cache, a lock nobody holds.

FFCx marks a module that it compiles by an empty C file, and others wait for the module. A process
that is killed, or stopped by Ctrl-C, leaves the file, and those who come later wait in vain. So a
process that begins leaves its name beside it, and a lock whose owner is gone is taken away.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import re
import shlex
import socket
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import dolfinx.jit
import dolfinx.mesh
import ufl
from cffi import VerificationError
from dolfinx import default_scalar_type, fem
from dolfinx.fem.forms import CompiledForm
from ffcx.codegeneration import jit
from ffcx.options import get_options

logger = logging.getLogger("mixed_fem")

# A lock without a name is some other program's, on this machine or another; compilers take less.
NAMELESS = 300.0  # [s]
ELSEWHERE = 3600.0  # [s]

# As long as its owner lives.
PATIENCE = 600.0  # [s]

Found = tuple[Any, Any]


class CompilationError(RuntimeError):
    """Forms cannot be compiled; the message is one line that names the remedy."""


def compile_together(forms: Any) -> Any:
    """Compile forms on one mesh into one library, which is quicker than one by one. Collective.

    Args:
        forms: A form, None where one vanishes, or lists of them, which may be nested. One over
            tagged parts is compiled by itself.

    Returns:
        The same with compiled forms.
    """
    together = [form for form in _leaves(forms) if _is_everywhere(form)]
    if not together:
        return fem.form(forms)
    domain = together[0].ufl_domain()
    mesh = dolfinx.mesh.Mesh(domain.ufl_cargo(), domain)
    objects, module, code = _compile(mesh.comm, together)
    made: dict[int, fem.Form] = {}
    for form, ufcx in zip(together, objects, strict=True):
        made[id(form)] = fem.create_form(
            CompiledForm(form, ufcx, module, code, default_scalar_type),
            [a.ufl_function_space() for a in form.arguments()],
            mesh,
            {},
            {f: f for f in form.coefficients()},
            {c: c for c in form.constants()},
        )
    return _replaced(forms, made)


def _compile_here(forms: list[ufl.Form]) -> Any:
    options = get_options({"scalar_type": default_scalar_type})
    return jit.compile_forms(list(forms), options=options, **dolfinx.jit.get_options())


_compile: Any = dolfinx.jit.mpi_jit_decorator(_compile_here)


def _leaves(forms: Any) -> Iterator[ufl.Form]:
    if isinstance(forms, list | tuple):
        for one in forms:
            yield from _leaves(one)
    elif isinstance(forms, ufl.Form):
        yield forms


def _replaced(forms: Any, made: dict[int, fem.Form]) -> Any:
    if isinstance(forms, list | tuple):
        return [_replaced(one, made) for one in forms]
    return made[id(forms)] if id(forms) in made else fem.form(forms)


def _is_everywhere(form: ufl.Form) -> bool:
    return all(
        integral.subdomain_data() is None and integral.subdomain_id() in ("everywhere", "otherwise")
        for integral in form.integrals()
    )


def compiler() -> list[str]:
    """The command that compiles C."""
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")


def no_compiler(said: str) -> CompilationError:
    """The error for a C compiler that has said something."""
    return CompilationError(
        f"the C compiler {shlex.join(compiler())!r} failed: {said}; install one (Debian: apt "
        "install gcc libc6-dev), or name it in the environment variable CC"
    )


def no_cache(folder: Path, error: OSError) -> CompilationError:
    """The error for a folder that compiled forms cannot be kept in."""
    return CompilationError(
        f"compiled forms cannot be kept in {folder} ({error.strerror or error}); set the "
        "environment variable XDG_CACHE_HOME to a folder that can be written to"
    )


def watch_ffcx() -> None:
    """Have FFCx look, from now on, for the owner of a lock, and say plainly what went wrong."""
    if not hasattr(jit.get_cached_module, "__wrapped__"):
        jit.get_cached_module = _looking(jit.get_cached_module)
        jit._compile_objects = _telling(jit._compile_objects)


def _telling(compile_objects: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(compile_objects)
    def tell(*args: Any, **kwargs: Any) -> Any:
        try:
            return compile_objects(*args, **kwargs)
        except OSError as e:
            raise no_cache(Path(e.filename or "the cache"), e) from e
        except VerificationError as e:
            told = re.sub(r"Command '\[.*?\]'", "its command", " ".join(str(e).split()))
            raise no_compiler(told) from e

    return tell


def _looking(get_cached_module: Callable[..., Found]) -> Callable[..., Found]:
    @functools.wraps(get_cached_module)
    def look(name: str, objects: Sequence[str], folder: str | Path, timeout: int) -> Found:
        lock, start = Path(folder) / f"{name}.c", time.monotonic()
        while True:
            remove_if_stale(lock)
            try:
                found = get_cached_module(name, objects, folder, 1)
                if found == (None, None):  # it is for us to compile
                    _owner_of(lock).write_text(json.dumps(_me()), "utf-8")
                return found
            except TimeoutError:
                limit = max(timeout, PATIENCE if _owner_of(lock).exists() else 0.0)
                if time.monotonic() - start > limit:
                    raise
            except OSError as e:
                raise no_cache(Path(folder), e) from e

    return look


def remove_if_stale(lock: Path) -> bool:
    """Remove a lock whose owner is gone; whether it was."""
    try:
        if lock.with_suffix(".c.cached").exists():
            return False
        age = time.time() - lock.stat().st_mtime
    except OSError:
        return False
    owner = _owner_of(lock)
    if not _is_gone(owner, age):
        return False
    logger.warning("removing %s, a lock of a compilation that was stopped", lock)
    for path in (owner, lock):
        path.unlink(missing_ok=True)
    return True


def _owner_of(lock: Path) -> Path:
    return lock.with_suffix(".c.owner")


def _me() -> dict[str, Any]:
    pid = os.getpid()
    return {
        "host": socket.gethostname(),
        "pid": pid,
        "start": _start(pid),
        "thread": threading.get_ident(),
    }


def _is_gone(owner: Path, age: float) -> bool:
    """Whether the owner of a lock of some age [s] is gone."""
    try:
        told = json.loads(owner.read_text("utf-8"))
        host, pid, start, thread = (told[key] for key in ("host", "pid", "start", "thread"))
    except (OSError, ValueError, KeyError, TypeError):
        return age > NAMELESS
    if host != socket.gethostname():
        return age > ELSEWHERE
    if pid == os.getpid():
        return bool(thread == threading.get_ident())  # whoever asks is not compiling
    return _start(pid) != start


def _start(pid: int) -> str:
    """When a process has begun, by which it is told from a later one of the same number."""
    try:
        state, *told = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
        return "gone" if state in "ZX" else told[18]  # a dead one whose parent has not looked yet
    except (OSError, IndexError):
        return "" if _exists(pid) else "gone"


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
