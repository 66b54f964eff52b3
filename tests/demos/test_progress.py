"""What a run says on the screen."""

from __future__ import annotations

import io

from mpi4py import MPI

import pytest

from demos.app.progress import Screen

COMM = MPI.COMM_WORLD


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.serial
def test_plain_lines_where_there_is_no_terminal():
    stream = io.StringIO()
    screen = Screen(COMM, stream)
    for k in range(11):
        screen.progress("march", k, 10, "fine" if k else "")
    assert stream.getvalue().splitlines() == [f"march {k:>2}/10  fine" for k in range(1, 11)]


@pytest.mark.serial
def test_a_bar_on_a_terminal():
    """The bar is redrawn in place, gives way to lines, and ends with its own."""
    stream = Terminal()
    screen = Screen(COMM, stream)
    screen.progress("march", 0, 2)
    screen.line("a remark")
    screen.progress("march", 1, 2, "halfway there")
    screen.progress("march", 2, 2)
    shown = [line.split("\r")[-1].rstrip() for line in stream.getvalue().split("\n")]
    assert shown == ["a remark", f"march [{'=' * 30}] 2/2", ""]


@pytest.mark.mpi
def test_other_ranks_are_silent():
    stream = io.StringIO()
    screen = Screen(COMM, stream)
    screen.line("once")
    screen.progress("march", 1, 1)
    assert (stream.getvalue() == "") == (COMM.rank != 0)
