"""The command line `mixed-fem`, also `python -m demos`.

Exit codes: 0 done, 1 a solve failed or a comparison fell short, 2 bad input (one line on stderr),
130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from mpi4py import MPI

from demos import compare, studies
from demos.output import OutputError
from demos.progress import Screen
from demos.run import run
from demos.scene import KERNELS, MOTIONS, SCHEMES, Overrides, built_in, load
from demos.tables import SceneError
from forms import FORMULATIONS, MATERIALS
from solvers import PRECONDITIONERS, SOLVERS

COMM = MPI.COMM_WORLD


class UsageError(ValueError):
    """The command line cannot be understood; the message is one line."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: Arguments, by default those of the process.

    Returns:
        The exit code, the same on all ranks.
    """
    if COMM.size > 1:
        sys.excepthook = _abort
    try:
        given, rest = (parser := _parser()).parse_known_args(argv)
        command: Callable[[argparse.Namespace], int] = given.command
        if rest:
            parser.error(f"unrecognized arguments: {' '.join(rest)}")
        return command(given)
    except (UsageError, SceneError, OutputError) as error:
        if COMM.rank == 0:
            print("mixed-fem:", *str(error).splitlines(), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        if COMM.rank == 0:
            print("mixed-fem: interrupted; what is written stays", file=sys.stderr, flush=True)
        if COMM.size > 1:  # others may wait for this rank
            COMM.Abort(130)
        return 130


def _list(_: argparse.Namespace) -> int:
    screen = Screen(COMM)
    sections = {
        "formulations": {name: f.description for name, f in FORMULATIONS.items()},
        "materials": {name: f"{m.description}; {m.formula}" for name, m in MATERIALS.items()},
        "motions": MOTIONS,
        "schemes": {name: (s.__doc__ or "").splitlines()[0] for name, s in SCHEMES.items()},
        "solvers": dict(SOLVERS),
        "preconditioners": {name: p.description for name, p in PRECONDITIONERS.items()},
        "kernels": KERNELS,
        "scenes": {name: load(COMM, name).description for name in built_in()},
        "studies": {name: study.description for name, study in studies.STUDIES.items()},
    }
    for section, entries in sections.items():
        screen.line(section)
        for name, description in entries.items():
            screen.line(f"  {name:<24}{description}")
    return 0


def _run(given: argparse.Namespace) -> int:
    if given.resume is not None:
        raise UsageError("--resume is not available yet; runs start at rest")
    overrides = Overrides(given.steps, given.formulation, given.material, given.solver)
    scene = load(COMM, given.scene, overrides)
    out = given.out if given.out is not None else Path("results") / scene.name
    failures = run(scene, COMM, out, Screen(COMM))
    if COMM.rank == 0:
        for failure in failures:
            print(f"mixed-fem: {failure}", file=sys.stderr)
    return 1 if failures else 0


def _compare(given: argparse.Namespace) -> int:
    return compare.run(COMM, given.json)


def _study(given: argparse.Namespace) -> int:
    study = studies.STUDIES.get(given.study)
    if study is None:
        raise UsageError(f"study {given.study}: unknown; available: {', '.join(studies.STUDIES)}")
    if study.starts_ranks and COMM.size > 1:
        raise UsageError(f"study {study.name} starts ranks by itself; run it without mpiexec")
    ranks = f"-{COMM.size}-ranks" if COMM.size > 1 else ""
    out = given.out if given.out is not None else Path("results") / f"{study.name}{ranks}"
    screen = Screen(COMM, sys.stderr if given.json else sys.stdout)
    try:
        outcome = studies.run(study, COMM, out, screen, quick=given.quick, fresh=given.fresh)
    except studies.Interrupted as error:
        screen.line(str(error))
        return 130
    if COMM.rank == 0 and given.json:
        print((out / f"{study.name}.json").read_text("utf-8"))
    elif COMM.rank == 0:
        for line in study.table(outcome.records):
            screen.line(line)
    screen.line(f"study {study.name}: files in {out}")
    for line in outcome.shortfalls:
        screen.line(f"falls short: {line}")
    return 1 if outcome.shortfalls else 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mixed-fem",
        description="Mixed variational finite elements for elastic bodies in motion.",
        epilog="Exit codes: 0 done, 1 a solve failed or a comparison fell short, 2 bad input, 130 "
        "interrupted. Runs under mpiexec too.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="name")

    listing = commands.add_parser(
        "list", help="show the formulations, materials, scenes, solvers and studies there are"
    )
    listing.set_defaults(command=_list)

    runner = commands.add_parser(
        "run",
        help="compute a scene and write its results and picture",
        description="Compute a scene. Written to DIR: final.npz (X, x, v, S, Lam, von_mises, in "
        "the order of the mesh file), history.csv (a row a step), newton.csv (a row a Newton "
        "iteration), fields/fields.pvd (for ParaView), picture.png.",
    )
    runner.add_argument(
        "scene", metavar="SCENE", help="name of a built-in scene, or path of a TOML file"
    )
    runner.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results (default: results/SCENE)"
    )
    runner.add_argument(
        "--steps", type=_integer, metavar="N", help="number of time steps, instead of the scene's"
    )
    runner.add_argument(
        "--formulation", metavar="F", help=f"one of {', '.join(FORMULATIONS)}; default: the scene's"
    )
    runner.add_argument(
        "--material", metavar="M", help=f"one of {', '.join(MATERIALS)}; default: the scene's"
    )
    runner.add_argument(
        "--solver", metavar="S", help=f"one of {', '.join(SOLVERS)}; default: the scene's"
    )
    runner.add_argument("--resume", metavar="FILE", help="not available yet")
    runner.set_defaults(command=_run)

    comparison = commands.add_parser(
        "compare",
        help="compare UFL with the hand-derived system, equation by equation",
        description="Compare the Newton system that UFL derives with one derived by hand in NumPy, "
        "equation by equation. The exit code is 1 if anything differs.",
    )
    comparison.add_argument(
        "--json", action="store_true", help="print one JSON document instead of the table"
    )
    comparison.set_defaults(command=_compare)

    student = commands.add_parser(
        "study",
        help="compute a grid of cases; table, files and figure",
        description="Compute the cases of a study that no earlier run of the same sources has, and "
        "write NAME.csv, NAME.json and, as pdf and png, a figure. Ctrl-C keeps what is done.",
    )
    student.add_argument("study", metavar="NAME", help="see mixed-fem list")
    student.add_argument("--quick", action="store_true", help="a small grid, in a minute or so")
    student.add_argument("--fresh", action="store_true", help="compute every case anew")
    student.add_argument(
        "--json", action="store_true", help="print one JSON document instead of the table"
    )
    student.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for the files (default: results/NAME)"
    )
    student.set_defaults(command=_study)
    return parser


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text!r}") from e


class _Parser(argparse.ArgumentParser):
    """An argument parser that speaks on rank 0 only, and complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")

    def print_help(self, file: Any = None) -> None:
        if COMM.rank == 0:
            super().print_help(file)


def _abort(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> Any:
    """An exception on one rank would leave the others waiting for ever."""
    traceback.print_exception(kind, error, trace)
    sys.stderr.flush()
    COMM.Abort(1)
