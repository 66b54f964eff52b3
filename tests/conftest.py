"""pytest under MPI: every rank runs every test, and they agree on each outcome.

After each phase of a test (set-up, call, teardown) the ranks exchange their outcomes. A failure on
one rank fails the test on all of them, and rank 0, the only one that prints, shows the reports of
the others. A rank that cannot be reached, because it waits in a collective that the failed one
never entered, ends the run by `MPI_Abort` after a bounded wait.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is imported

import functools
import gc
import importlib.metadata
import sys
import time
import zlib
from collections.abc import Generator
from pathlib import Path

from mpi4py import MPI

import hypothesis
import numpy as np
import pytest

# Compiling is what the tests take time for, and not what they are about: with the options there, a
# third of it. Processes that the tests start take them too, and so find the same forms.
os.environ["XDG_CONFIG_HOME"] = str(Path(__file__).parent / "config")
os.environ.setdefault("MPLCONFIGDIR", str(Path(__file__).parents[1] / ".cache" / "matplotlib"))

# setuptools looks at all that is installed, six times for each form that is compiled.
importlib.metadata.entry_points = functools.cache(importlib.metadata.entry_points)

WAIT = 300.0  # [s] for the others to end a phase that this rank has passed
WAIT_AFTER_FAILURE = 30.0  # [s] for the others to end a phase that this rank has failed

# Apart from COMM_WORLD, so that these messages meet none of the tests'.
comm = MPI.COMM_WORLD.Dup()

# Ranks must draw the same examples. Shrinking would run collectives on the failed rank alone.
hypothesis.settings.register_profile("mixed-fem", derandomize=True, deadline=None)
hypothesis.settings.register_profile(
    "mixed-fem-mpi",
    hypothesis.settings.get_profile("mixed-fem"),
    phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),
)
# On one rank, to look for hours: HYPOTHESIS_PROFILE=long, as often as EXAMPLES says.
hypothesis.settings.register_profile(
    "long", deadline=None, max_examples=int(os.environ.get("EXAMPLES", "10000"))
)
hypothesis.settings.load_profile(
    os.environ.get("HYPOTHESIS_PROFILE", "mixed-fem") if comm.size == 1 else "mixed-fem-mpi"
)


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what has been imported, and over much else less often."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what asks for another number of ranks."""
    needless = "mpi" if comm.size == 1 else "serial"
    reason = "needs two ranks or more" if comm.size == 1 else "needs a single rank"
    for item in items:
        if item.get_closest_marker(needless):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture
def tmp_path(tmp_path: Path) -> Path:
    """The same folder on every rank."""
    return MPI.COMM_WORLD.bcast(tmp_path, root=0)


class ParallelRun:
    """The plugin of a run on several ranks."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.collect_errors: list[str] = []

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Keep import errors, which may be of this rank alone."""
        if report.failed:
            self.collect_errors.append(report.longreprtext)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """End the run if the ranks collected different tests."""
        text = "\n".join(self.collect_errors)
        names = "\n".join(item.nodeid for item in session.items)
        facts = self.exchange([code(names), len(self.collect_errors)], "collection", text)
        if (facts != facts[0]).any():
            texts = comm.allgather(f"{len(session.items)} tests\n{text}".rstrip())
            raise pytest.UsageError("the ranks collected different tests\n" + by_rank(texts))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Fail a test on every rank if the ranks differ in its outcome or in where it failed."""
        report = yield
        crash = getattr(report.longrepr, "reprcrash", None)
        place = f"{crash.path}:{crash.lineno}" if report.failed and crash else ""
        facts = self.exchange(
            [code(f"{item.nodeid} {report.when}"), code(report.outcome), code(place)],
            f"{item.nodeid} ({report.when}) {report.outcome}",
            report.longreprtext if report.failed else "",
        )
        if (facts[:, 0] != facts[0, 0]).any():
            self.abort(f"is at {item.nodeid} ({report.when}), the others are elsewhere")
        if (facts != facts[0]).any():
            outcomes = comm.allgather(report.outcome)
            texts = comm.allgather(f"{report.outcome}\n{report.longreprtext}".rstrip())
            report.outcome = "failed"
            report.longrepr = f"ranks differ: {', '.join(outcomes)}\n" + by_rank(texts)
        return report

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(
        self, item: pytest.Item, nextitem: pytest.Item | None
    ) -> Generator[None, object, object]:
        """Destroy what a test leaves behind at the same place on all ranks.

        Of what it has made itself; at the end of a file of all there is, which takes its time.
        """
        result = yield
        if nextitem is None or nextitem.path != item.path:
            gc.unfreeze()
        gc.collect()
        gc.freeze()
        self.exchange([0], f"{item.nodeid} (garbage collection)")
        return result

    def exchange(self, facts: list[int], where: str, failure: str = "") -> np.ndarray:
        """Gather a row of integers from each rank, in bounded time."""
        mine = np.array(facts, dtype=np.int64)
        rows = np.empty((comm.size, mine.size), dtype=np.int64)
        request = comm.Iallgather(mine, rows)
        limit = WAIT_AFTER_FAILURE if failure else WAIT
        start = time.monotonic()
        pause = 1e-5  # [s]
        while not request.Test():
            if time.monotonic() - start > limit:
                self.abort(f"{where}, and the others have not come for {limit:g} s\n{failure}")
            time.sleep(pause)
            pause = min(2 * pause, 1e-3)
        return rows

    def abort(self, message: str) -> None:
        """Say why on the real stderr, and end all ranks."""
        capture = self.config.pluginmanager.getplugin("capturemanager")
        with capture.global_and_fixture_disabled():
            print(f"\nrank {comm.rank}: {message}", file=sys.stderr, flush=True)
            comm.Abort(1)


def code(text: str) -> int:
    """A number for a text that is the same on every rank."""
    return zlib.crc32(text.encode())


def by_rank(texts: list[str]) -> str:
    """The texts of all ranks under one another."""
    return "\n".join(f"---- rank {rank}: {text}" for rank, text in enumerate(texts))


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Under MPI let rank 0 alone print, and the ranks agree on outcomes."""
    if comm.size > 1:
        config.pluginmanager.register(ParallelRun(config), "parallel-run")
        if comm.rank > 0:
            config.pluginmanager.unregister(name="terminalreporter")
