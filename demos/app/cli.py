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

from demos import studies
from demos.app import keys, measures, mesh_report, petsc_options, viewer
from demos.app import sweep as sweeping
from demos.app.arguments import COMM, UsageError, parser
from demos.app.files import OutputError, cannot_write
from demos.app.progress import Screen
from demos.app.run import Restart, run
from demos.app.scene import Overrides, built_in, load
from demos.app.tables import SceneError
from demos.viewing import ResultsError, plot
from demos.viewing import load as load_results
from forms import FORMULATIONS, LOADS, MATERIALS, MOTIONS, SCHEMES, CompilationError
from meshes import GEOMETRIES
from solvers import PRECONDITIONERS, SOLVERS, STRATEGIES, CheckpointError

_BAD_INPUT = (
    UsageError,
    SceneError,
    OutputError,
    CheckpointError,
    studies.StudyError,
    ResultsError,
)


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
        given = parser().parse_args(arguments, argparse.Namespace(petsc=options))
        command = COMMANDS[given.name]
        if misspelt := [name for name in options if name in vars(given)]:
            raise UsageError(f"-{misspelt[0]}: with one dash it would go to PETSc; write two")
        with petsc_options.entered(options):
            code = command(given)
            if (unread := petsc_options.unread(options)) and COMM.rank == 0:
                message = f"mixed-fem: PETSc options that nothing has read: {' '.join(unread)}"
                print(message, file=sys.stderr)
        return code
    except _BAD_INPUT as error:
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
    failure = run(scene, COMM, out, Screen(COMM, quiet=given.quiet), restart)
    if failure and COMM.rank == 0:
        print(f"mixed-fem: {failure}", file=sys.stderr)
    return 1 if failure else 0


def _compare(given: argparse.Namespace) -> int:
    from demos.by_hand import ERRATA, compare  # here, as SciPy takes a third of a second

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


def _view(given: argparse.Namespace) -> int:
    _alone("view")
    arguments = [str(given.results), "--field", given.field]
    for name in ("picture", "movie", "step"):
        if (value := getattr(given, name)) is not None:
            arguments += [f"--{name}={value}"]
    if given.picture is not None and given.picture.suffix != ".png":
        raise UsageError(f"--picture {given.picture}: must end in .png")
    if given.movie is not None and given.movie.suffix not in (".mp4", ".gif"):
        raise UsageError(f"--movie {given.movie}: must end in .mp4 or .gif")
    if given.step is not None and given.picture is None:
        raise UsageError(f"--step {given.step}: goes with --picture")
    if given.web:
        arguments += [f"--port={given.port}"]
    code, wrong = viewer.view(arguments)
    if wrong:
        print(f"mixed-fem: {wrong}", file=sys.stderr)
    for written in filter(None, (given.picture, given.movie)):
        if code == 0:
            Screen(COMM).line(f"view: wrote {written}")
    return code


def _plot(given: argparse.Namespace) -> int:
    _alone("plot")
    out = given.out if given.out is not None else given.results / "plot.png"
    if out.suffix not in (".png", ".pdf", ".svg"):
        raise UsageError(f"--out {out}: must end in .png, .pdf or .svg")
    try:
        plot(load_results(given.results)).savefig(out)
    except OSError as error:
        raise OutputError(cannot_write(out, error)) from error
    Screen(COMM).line(f"plot: wrote {out}")
    return 0


def _alone(command: str) -> None:
    if COMM.size > 1:
        raise UsageError(f"{command} works on one rank; run it without mpiexec")


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


def _abort(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> Any:
    """An exception on one rank would leave the others waiting for ever."""
    traceback.print_exception(kind, error, trace)
    sys.stderr.flush()
    COMM.Abort(1)


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "list": _list,
    "run": _run,
    "compare": _compare,
    "mesh": _mesh,
    "study": _study,
    "sweep": _sweep,
    "view": _view,
    "plot": _plot,
}
