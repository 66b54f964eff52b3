"""The command line `mixed-fem`, also `python -m demos`.

Exit codes: 0 done, 1 a solve failed or a comparison fell short, 2 bad input (one line on stderr),
130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from mpi4py import MPI

from demos import studies
from demos.app import keys, measures, mesh_report, petsc_options
from demos.app import sweep as sweeping
from demos.app.files import OutputError
from demos.app.progress import Screen
from demos.app.run import Restart, run
from demos.app.scene import Overrides, built_in, load
from demos.app.tables import SceneError
from demos.by_hand import ERRATA, compare
from forms import FORMULATIONS, LOADS, MATERIALS, MOTIONS, SCHEMES, CompilationError
from meshes import GEOMETRIES
from solvers import PRECONDITIONERS, SOLVERS, STRATEGIES, CheckpointError

COMM = MPI.COMM_WORLD


class UsageError(ValueError):
    """The command line cannot be understood; the message is one line."""


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM."""


def _of_compilation(error: RuntimeError) -> str:
    """What the error says if it is one of compilation, on any rank; else nothing."""
    if isinstance(error, CompilationError):
        return str(error)
    # What DOLFINx makes of it on several ranks; the others only know that it failed.
    return str(error).partition(" of form: ")[2] or str(error) if "JIT comp" in str(error) else ""


def _terminate(number: int, frame: object) -> NoReturn:
    raise Terminated


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: Arguments, by default those of the process.

    Returns:
        The exit code, the same on all ranks.
    """
    if COMM.size > 1:
        sys.excepthook = _abort
    for stream in (sys.stdout, sys.stderr):  # of any encoding
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as Python has it; PETSc would abort
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)
    try:
        arguments, options = petsc_options.split(sys.argv[1:] if argv is None else argv)
        given = _parser().parse_args(arguments, argparse.Namespace(petsc=options))
        command: Callable[[argparse.Namespace], int] = given.command
        if misspelt := [name for name in options if name in vars(given)]:
            raise UsageError(f"-{misspelt[0]}: with one dash it would go to PETSc; write two")
        with petsc_options.entered(options):
            code = command(given)
            if (unread := petsc_options.unread(options)) and COMM.rank == 0:
                message = f"mixed-fem: PETSc options that nothing has read: {' '.join(unread)}"
                print(message, file=sys.stderr)
        return code
    except (UsageError, SceneError, OutputError, CheckpointError, studies.StudyError) as error:
        if COMM.rank == 0:
            print("mixed-fem:", *str(error).splitlines(), file=sys.stderr)
        return 2
    except RuntimeError as error:
        if not (told := _of_compilation(error)):
            raise
        if COMM.rank == 0:
            print("mixed-fem:", told, file=sys.stderr)
        return 2
    except BrokenPipeError:  # whoever reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt as error:
        code = 143 if isinstance(error, Terminated) else 130
        if COMM.rank == 0:
            told = str(error) or "what is written stays"
            print(f"mixed-fem: interrupted; {told}", file=sys.stderr, flush=True)
        if COMM.size > 1 and not hasattr(error, "on_all_ranks"):  # others may wait for this rank
            COMM.Abort(code)
        return code


def _list(_: argparse.Namespace) -> int:
    screen = Screen(COMM)
    sections = {
        "formulations": {name: f.description for name, f in FORMULATIONS.items()},
        "materials": {name: f"{m.description}; {m.formula}" for name, m in MATERIALS.items()},
        "motions": keys.described(MOTIONS),
        "loads": keys.described(LOADS),
        "schemes": keys.described(SCHEMES),
        "solvers": dict(SOLVERS),
        "globalisations": {
            name: (s.__doc__ or "").splitlines()[0] for name, s in STRATEGIES.items()
        },
        "preconditioners": {name: p.description for name, p in PRECONDITIONERS.items()},
        "geometries": {name: g.description for name, g in GEOMETRIES.items()},
        "measures": measures.KINDS,
        "scenes": {name: load(COMM, name).description for name in built_in()},
        "studies": {name: study.description for name, study in studies.STUDIES.items()},
    }
    for section, entries in sections.items():
        screen.line(section)
        for name, description in entries.items():
            screen.line(f"  {name:<24}{description}")
    return 0


def _run(given: argparse.Namespace) -> int:
    if given.checkpoint < 0:
        raise UsageError(f"--checkpoint {given.checkpoint}: must be a number of steps, or 0")
    file = None if given.resume in (None, "") else Path(given.resume)
    restart = Restart(given.checkpoint, given.resume is not None, file)
    overrides = Overrides(given.steps, given.formulation, given.material, given.solver)
    scene = load(COMM, given.scene, overrides)
    out = given.out if given.out is not None else Path("results") / scene.name
    failures = run(scene, COMM, out, Screen(COMM), restart)
    if COMM.rank == 0:
        for failure in failures:
            print(f"mixed-fem: {failure}", file=sys.stderr)
    return 1 if failures else 0


def _compare(given: argparse.Namespace) -> int:
    last = ERRATA[-1].number
    if given.equation is not None and not 1 <= given.equation <= last:
        raise UsageError(f"equation {given.equation}: the seed numbers its equations 1 to {last}")
    return compare.run(COMM, given.json, given.equation)


def _mesh(given: argparse.Namespace) -> int:
    return mesh_report.run(COMM, given.file, given.scale, given.json)


def _study(given: argparse.Namespace) -> int:
    chosen = _studies(given.study)
    if len(chosen) > 1 and given.json:
        names = ", ".join(study.name for study in chosen)
        raise UsageError(f"--json: goes with one study, and {given.study} has {names}")
    if COMM.size > 1 and (alone := [study.name for study in chosen if study.starts_ranks]):
        raise UsageError(f"study {alone[0]} starts ranks by itself; run it without mpiexec")
    return _run_studies(chosen, given)


def _run_studies(chosen: Sequence[studies.Study], given: argparse.Namespace) -> int:
    try:
        shortfalls = [line for study in chosen for line in _one_study(study, given)]
    except studies.Interrupted as error:
        Screen(COMM, sys.stderr if given.json else sys.stdout).line(str(error))
        return 130
    return 1 if shortfalls else 0


def _sweep(given: argparse.Namespace) -> int:
    try:
        study = sweeping.sweep(
            COMM, given.scene, [sweeping.axis(text) for text in given.vary], given.measure
        )
    except measures.MeasureError as error:
        raise UsageError(str(error)) from error
    return _run_studies([study], given)


def _studies(name: str) -> Sequence[studies.Study]:
    """The study of a name, or those of a file."""
    if name in studies.STUDIES:
        return [studies.STUDIES[name]]
    if name.endswith(".py"):
        return studies.studies_in(COMM, Path(name), studies.STUDIES.values())
    available = ", ".join(studies.STUDIES)
    raise UsageError(f"study {name}: unknown; available: {available}, or the path of a Python file")


def _one_study(study: studies.Study, given: argparse.Namespace) -> list[str]:
    ranks = f"-{COMM.size}-ranks" if COMM.size > 1 else ""
    out = given.out if given.out is not None else Path("results") / f"{study.name}{ranks}"
    screen = Screen(COMM, sys.stderr if given.json else sys.stdout)
    outcome = studies.run(
        study, COMM, out, screen, quick=given.quick, fresh=given.fresh, kept=not given.petsc
    )
    if COMM.rank == 0 and given.json:
        print((out / f"{study.name}.json").read_text("utf-8"))
    elif COMM.rank == 0:
        for line in study.table(outcome.records):
            screen.line(line)
    screen.line(f"study {study.name}: files in {out}")
    for line in outcome.shortfalls:
        screen.line(f"falls short: {line}")
    return outcome.shortfalls


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mixed-fem",
        description="Mixed variational finite elements for elastic bodies in motion.",
        epilog="Options with one dash, such as -mixed_fem_0_snes_monitor, go to PETSc. Put them "
        "last, as what follows one may be its value. Exit codes: 0 done, 1 a solve failed or a "
        "comparison fell short, 2 bad input, 130 interrupted. Runs under mpiexec too.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="name")

    listing = commands.add_parser(
        "list",
        help="show the materials, formulations, geometries, scenes, studies, ... there are",
    )
    listing.set_defaults(command=_list)

    runner = commands.add_parser(
        "run",
        help="compute a scene and write its results and picture",
        description="Compute a scene. Written to DIR: final.npz (X, x, v, S, Lam, von_mises, in "
        "the order of the mesh file), history.csv (a row a step), newton.csv (a row a Newton "
        "iteration), fields/fields.pvd (for ParaView), checkpoint.npz, run.json (what was run, and "
        "by what), picture.png. Ctrl-C ends a run after the step under way, with a checkpoint.",
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
    runner.add_argument(
        "--resume",
        nargs="?",
        const="",
        metavar="FILE",
        help="go on from a checkpoint, by default that of DIR, on any number of ranks; give the "
        "same scene, with more steps if you like",
    )
    runner.add_argument(
        "--checkpoint",
        type=_integer,
        default=10,
        metavar="N",
        help="write a checkpoint every N steps, and at the end (default: 10; 0: at the end alone)",
    )
    runner.set_defaults(command=_run)

    comparison = commands.add_parser(
        "compare",
        help="compare UFL with the hand-derived system, equation by equation",
        description="Compare the Newton system that UFL derives with one derived by hand in NumPy, "
        "equation by equation. The exit code is 1 if anything differs.",
    )
    comparison.add_argument(
        "--equation",
        type=_integer,
        metavar="N",
        help="one equation: as in the seed, as it should be, what is compared, the numbers",
    )
    comparison.add_argument(
        "--json", action="store_true", help="print one JSON document instead of the table"
    )
    comparison.set_defaults(command=_compare)

    inspector = commands.add_parser(
        "mesh",
        help="show what a mesh file holds, and what is wrong with it",
        description="Counts, sizes, tags, quality and connected parts of a mesh file, and all that "
        "is wrong with it. Cells and vertices count from 0, in file order. The exit code is 2 if "
        "the mesh cannot be used.",
    )
    inspector.add_argument("file", metavar="FILE", type=Path, help="a mesh file")
    inspector.add_argument(
        "--scale", type=float, default=1.0, help="metres in a unit of the file (default: 1)"
    )
    inspector.add_argument(
        "--json", action="store_true", help="print one JSON document instead of text"
    )
    inspector.set_defaults(command=_mesh)

    student = commands.add_parser(
        "study",
        help="compute a grid of cases; table, files and figure",
        description="Compute the cases of a study that no earlier run of the same sources has, and "
        "write NAME.csv, NAME.json and, as pdf and png, a figure. Ctrl-C keeps what is done. With "
        "PETSc options every case is computed anew, and none is kept.",
    )
    student.add_argument(
        "study",
        metavar="NAME",
        help="see mixed-fem list; or the path of a Python file, whose studies are run: every "
        "demos.studies.Study at its top level",
    )
    student.add_argument("--quick", action="store_true", help="a small grid, in a minute or so")
    student.add_argument("--fresh", action="store_true", help="compute every case anew")
    student.add_argument(
        "--json", action="store_true", help="print one JSON document instead of the table"
    )
    student.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for the files (default: results/NAME)"
    )
    student.set_defaults(command=_study)

    sweeper = commands.add_parser(
        "sweep",
        help="run a scene over a grid of its settings, and measure",
        description="Run a scene for all combinations of some settings, and write what was "
        "measured as a table, CSV, JSON and a figure. Along mesh.refine, mesh.h and time.h it "
        "tells the observed order, what Richardson extrapolates, how far the finest value may be "
        "from that (grid convergence index), and whether the series is asymptotic. With another "
        "time.h the number of steps changes so that the end stays. Cases are kept; Ctrl-C keeps "
        "what is done.",
    )
    sweeper.add_argument("scene", metavar="SCENE", help="name of a built-in scene, or path")
    sweeper.add_argument(
        "--vary",
        metavar="KEY=VALUES",
        action="append",
        required=True,
        help="a key of the scene and its values, as mesh.refine=0:3 (0, 1, 2, 3), "
        "time.h=0.1,0.05 or material.2.E=1e5,1e6; may be given again",
    )
    sweeper.add_argument(
        "--measure",
        metavar="NAME",
        action="append",
        required=True,
        help="what to measure, see mixed-fem list; may be given again",
    )
    sweeper.add_argument("--fresh", action="store_true", help="compute every case anew")
    sweeper.add_argument(
        "--json", action="store_true", help="print one JSON document instead of the table"
    )
    sweeper.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for the files (default: results/sweep-SCENE)",
    )
    sweeper.set_defaults(command=_sweep, quick=False)
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
