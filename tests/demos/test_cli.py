"""The command line: what it lists, refuses and hands to PETSc."""

from __future__ import annotations

import re

from mpi4py import MPI
from petsc4py import PETSc

import pytest
import ufl

from demos.app import petsc_options
from demos.app.cli import main
from demos.app.scene import built_in
from forms import FORMULATIONS, MATERIALS, displacement_field
from solvers import PRECONDITIONERS, SOLVERS, MixedProblem
from tests.demos.scenes import bar as bar_text
from tests.states import small_mesh

COMM = MPI.COMM_WORLD


def said(capfd) -> str:
    """Standard error of rank 0; every other rank must be silent."""
    captured = capfd.readouterr()
    if COMM.rank != 0:
        assert captured.err == ""
    return COMM.bcast(captured.err)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "the following arguments are required: COMMAND (see mixed-fem --help)"),
        (["runn"], "invalid choice: 'runn'"),
        (["run"], "the following arguments are required: SCENE (see mixed-fem run --help)"),
        (["run", "hanging-bra"], "hanging-bra: neither a built-in scene nor a file (did you mean "),
        (["run", "nothing.toml"], "nothing.toml: neither a built-in scene nor a file; built-in"),
        (["run", "."], ".: cannot be read"),
        (["run", "hanging-bar", "--steps", "many"], "--steps: must be a whole number, not 'many'"),
        (["run", "hanging-bar", "--steps", "0"], "--steps 0: must be a whole number of 1 or more"),
        (["run", "hanging-bar", "--solver", "fieldspilt"], "(did you mean fieldsplit?)"),
        (["run", "hanging-bar", "--resume", "x.h5"], "x.h5: no such file"),
        (["run", "hanging-bar", "--out", "/dev/null/x"], "--out /dev/null/x: cannot be written to"),
        (["run", "hanging-bar", "--fast"], "unrecognized arguments: --fast"),
        (
            ["study", "rate", "--quick"],
            "study rate: unknown; available: benchmark, conservation, cost,",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_gets_one_line_and_exit_code_2(argv, message, capfd):
    assert main(argv) == 2
    err = said(capfd)
    assert err.startswith("mixed-fem: ")
    assert message in err
    assert err.count("\n") == 1


def test_list_shows_every_name_there_is(capfd):
    assert main(["list"]) == 0
    out = COMM.bcast(capfd.readouterr().out)
    for name in (
        *FORMULATIONS,
        *MATERIALS,
        *SOLVERS,
        *PRECONDITIONERS,
        *built_in(),
        "backward-euler",
        "fixed",
    ):
        assert re.search(rf"^  {re.escape(name)}\s+\S+", out, flags=re.M), name


@pytest.mark.parametrize("argv", [["--help"], ["run", "--help"]])
def test_help(argv, capfd):
    with pytest.raises(SystemExit) as left:
        main(argv)
    assert left.value.code == 0
    captured = capfd.readouterr()
    assert captured.err == ""
    assert ("usage: mixed-fem" in captured.out) == (COMM.rank == 0)


# PETSc options


@pytest.mark.parametrize(
    ("arguments", "others", "options"),
    [
        (["run", "a.toml", "-snes_view"], ["run", "a.toml"], {"snes_view": None}),
        (["-a", "gmres", "-b", "-3", "-c", "1e-2"], [], {"a": "gmres", "b": "-3", "c": "1e-2"}),
        (["-a", "--quick", "-b", "-c"], ["--quick"], {"a": None, "b": None, "c": None}),
        (["run", "--steps", "-1", "-h", "-help"], ["run", "--steps", "-1", "-h", "-help"], {}),
        (["-a", "1", "-a", "2"], [], {"a": "2"}),
    ],
)
def test_options_with_one_dash_are_petscs(arguments, others, options):
    assert petsc_options.split(arguments) == (others, options)


BAR = bar_text("h = 0.1\nsteps = 1\n", material="corotational")


def next_prefix():
    """What PETSc calls the options of the problem that will be built next."""
    u = displacement_field(small_mesh(2))
    problem = MixedProblem(ufl.inner(u, u) * ufl.dx, (u,))
    last = problem.problem.solver.getOptionsPrefix()
    return re.sub(r"\d+", lambda number: str(int(number[0]) + 1), last)


def test_petsc_options_reach_the_problem(tmp_path, capfd):
    """PETSc's monitor prints, its limit of iterations holds, and what nothing reads is named."""
    scene = tmp_path / "bar.toml"
    if COMM.rank == 0:
        scene.write_text(BAR, "utf-8")
    COMM.barrier()
    command = ["run", str(scene), "--out", str(tmp_path / "out")]
    prefix = next_prefix()
    code = main([*command, f"-{prefix}snes_monitor", f"-{prefix}snes_max_it", "1", "-nobody", "2"])
    out, err = COMM.bcast(capfd.readouterr())
    assert code == 1
    assert "DIVERGED_MAX_IT" in err
    assert [line.split()[:4] for line in out.splitlines() if "SNES Function norm" in line] == [
        [str(k), "SNES", "Function", "norm"] for k in (0, 1)
    ]
    assert err.endswith("mixed-fem: PETSc options that nothing has read: -nobody\n")
    assert not {"nobody", f"{prefix}snes_max_it"} & set(PETSc.Options().getAll())
    assert main(command) == 0


def test_an_option_with_a_dash_too_few_is_not_taken_for_petscs(capfd):
    assert main(["run", "hanging-bar", "-steps", "3"]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error == "mixed-fem: -steps: with one dash it would go to PETSc; write two\n"
