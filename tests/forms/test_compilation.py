"""Locks that nobody holds, and compilers and caches that are not there."""

from __future__ import annotations

import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time

import pytest
from ffcx.codegeneration import jit

from forms import compilation

pytestmark = pytest.mark.serial


@pytest.fixture
def lock(tmp_path):
    path = tmp_path / "libffcx_forms_1.c"
    path.touch()
    return path


def owned(lock, **changes):
    """Leave a name beside a lock."""
    me = compilation._me() | changes
    compilation._owner_of(lock).write_text(json.dumps(me))


def aged(lock, seconds):
    then = time.time() - seconds
    os.utime(lock, (then, then))


def test_ffcx_is_watched_once():
    first = jit.get_cached_module
    compilation.watch_ffcx()
    assert jit.get_cached_module is first


def test_a_lock_whose_owner_is_gone_is_removed(lock, caplog):
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    owned(lock, pid=process.pid, start="gone long ago")
    with caplog.at_level(logging.WARNING):
        assert compilation.remove_if_stale(lock)
    assert not list(lock.parent.iterdir())
    assert "a lock of a compilation that was stopped" in caplog.text


def test_a_dead_process_that_nobody_has_waited_for_is_gone(lock):
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    owned(lock, pid=process.pid, start=compilation._start(process.pid))
    assert not compilation.remove_if_stale(lock)
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert compilation.remove_if_stale(lock)
    process.communicate()


def test_a_lock_of_this_process_and_thread_is_one_that_it_was_stopped_at(lock):
    owned(lock)
    assert compilation.remove_if_stale(lock)


@pytest.mark.parametrize(
    ("owner", "age", "stale"),
    [
        ({"thread": -1}, 1e6, False),  # another thread of this process is at work
        ({"pid": os.getppid(), "start": compilation._start(os.getppid())}, 1e6, False),
        ({"pid": os.getppid(), "start": "another of that number"}, 0.0, True),
        ({"host": "elsewhere"}, 10.0, False),
        ({"host": "elsewhere"}, 1e5, True),
        (None, 10.0, False),
        (None, 1e5, True),
    ],
)
def test_which_locks_are_stale(owner, age, stale, lock):
    if owner is not None:
        owned(lock, **owner)
    aged(lock, age)
    assert compilation.remove_if_stale(lock) == stale
    assert lock.exists() != stale


def test_what_is_compiled_is_no_lock(lock):
    lock.with_suffix(".c.cached").touch()
    owned(lock, pid=2**22 + 1)
    assert not compilation.remove_if_stale(lock)


def test_the_next_one_compiles(lock):
    """FFCx is told that the module is its to make, and its name stands beside the lock."""
    owned(lock, pid=os.getppid(), start="another of that number")
    assert jit.get_cached_module(lock.stem, [], lock.parent, 1) == (None, None)
    told = json.loads(compilation._owner_of(lock).read_text())
    assert (told["pid"], told["host"]) == (os.getpid(), socket.gethostname())


def test_a_lock_that_is_held_is_waited_for(lock, monkeypatch):
    monkeypatch.setattr(compilation, "PATIENCE", 0.0)
    owned(lock, thread=threading.get_ident() + 1)
    with pytest.raises(TimeoutError):
        jit.get_cached_module(lock.stem, [], lock.parent, 1)


PROGRAM = """
from mpi4py import MPI
import ufl
from dolfinx import fem, mesh
import forms
msh = mesh.create_unit_interval(MPI.COMM_WORLD, 3)
try:
    fem.form(ufl.SpatialCoordinate(msh)[0] * ufl.dx)
except forms.CompilationError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("CC", "/nonexistent/cc", "install one (Debian: apt install gcc libc6-dev), or name it in"),
        ("CC", "false", "its command returned non-zero exit status 1"),
        ("XDG_CACHE_HOME", "/proc", "compiled forms cannot be kept in /proc/fenics"),
    ],
)
def test_what_is_missing_is_named_in_a_line(variable, value, message, tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), variable: value}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert message in done.stdout, done.stderr
    assert done.stdout.count("\n") == 1
