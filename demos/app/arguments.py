"""The command line of `mixed-fem`: its commands, arguments and their help."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from mpi4py import MPI

from demos.viewing import FIELDS
from forms import FORMULATIONS, MATERIALS
from solvers import SOLVERS

COMM = MPI.COMM_WORLD


class UsageError(ValueError):
    """The command line asks for what there is not; the message is one line."""


def parser() -> argparse.ArgumentParser:
    """The parser of the command line; `name` is the command."""
    whole = _Parser(
        prog="mixed-fem",
        description="Mixed variational finite elements for elastic bodies in motion.",
        epilog="Options with one dash, such as -mixed_fem_0_snes_monitor, go to PETSc. Put them "
        "last, as what follows one may be its value. Exit codes: 0 done, 1 a solve failed or a "
        "comparison fell short, 2 bad input, 130 interrupted. Runs under mpiexec too.",
    )
    commands = whole.add_subparsers(required=True, metavar="COMMAND", dest="name")

    commands.add_parser(
        "list",
        help="show the materials, formulations, geometries, scenes, studies, ... there are",
    )

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
    runner.add_argument("--quiet", action="store_true", help="say nothing unless a step fails")
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
    _add_json(comparison, "the table")

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
    _add_json(inspector, "text")

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
    _add_json(student, "the table")
    student.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for the files (default: results/NAME)"
    )

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
    _add_json(sweeper, "the table")
    sweeper.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for the files (default: results/sweep-SCENE)",
    )
    sweeper.set_defaults(quick=False)

    viewer = commands.add_parser(
        "view",
        help="look at the results of a run: a window, a page in a browser, a picture, a movie",
        description="Show the body over time, coloured by a field. In the window the space bar "
        "plays, the arrow keys go a step on or back.",
    )
    viewer.add_argument("results", metavar="RESULTS", type=Path, help="folder of a run")
    viewer.add_argument(
        "--field",
        choices=list(FIELDS),
        default="strain",
        help="; ".join(f"{name}: {field.description}" for name, field in FIELDS.items()),
    )
    how = viewer.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve a page on the loopback address")
    how.add_argument("--picture", metavar="FILE.png", type=Path, help="write a picture")
    how.add_argument("--movie", metavar="FILE.mp4|gif", type=Path, help="write a movie")
    viewer.add_argument(
        "--step", type=_integer, metavar="N", help="of the picture (default: the last)"
    )
    viewer.add_argument(
        "--port", type=_integer, default=8080, metavar="N", help="of the page (default: 8080)"
    )

    plotter = commands.add_parser(
        "plot",
        help="draw energies, iterations, residuals and reactions of a run",
        description="Draw the tables of a run: energies and their balance, Newton iterations, "
        "the residuals of each step, reactions.",
    )
    plotter.add_argument("results", metavar="RESULTS", type=Path, help="folder of a run")
    plotter.add_argument(
        "--out", metavar="FILE", type=Path, help="png, pdf or svg (default: RESULTS/plot.png)"
    )
    return whole


def _add_json(command: argparse.ArgumentParser, otherwise: str) -> None:
    told = f"print one JSON document instead of {otherwise}"
    command.add_argument("--json", action="store_true", help=told)


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
