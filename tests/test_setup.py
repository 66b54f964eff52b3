"""The search for an interpreter, on machines made of stubs; nothing is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.serial

CHECKOUT = Path(__file__).parents[1]
TOOLS = "bash awk cat cut cksum dirname env getconf grep head mktemp rm sed sort timeout".split()


class Machine:
    """A machine with the tools that every Linux has, and no Python until one is put there."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.path = [root / "bin"]
        self.variables: dict[str, str] = {}
        self.checkout = root / "checkout"
        self.checkout.joinpath("tools").mkdir(parents=True)
        shutil.copy(CHECKOUT / "tools/setup.sh", self.checkout / "tools")
        shutil.copy(CHECKOUT / "pyproject.toml", self.checkout)
        self.path[0].mkdir()
        for tool in TOOLS:
            place = shutil.which(tool)
            assert place, tool
            self.path[0].joinpath(tool).symlink_to(place)

    def executable(self, place: str, script: str) -> Path:
        """Put a shell script there."""
        file = self.root / place
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"#!{shutil.which('bash')}\n{script}\n")
        file.chmod(0o755)
        return file

    def python(self, place: str, version: str = "3.13", dolfinx: str = "") -> Path:
        """An interpreter of this version, which imports a DOLFINx of that version or none.

        It is the one that this test's environment was made from, told to say another version.
        """
        site = self.root / "site" / place
        site.mkdir(parents=True)
        for module in ("mpi4py", "petsc4py", "dolfinx"):
            site.joinpath(module).mkdir()
            site.joinpath(module, "__init__.py").write_text(
                f"__version__ = {dolfinx!r}\n" if dolfinx else "raise ImportError"
            )
        site.joinpath("mpi4py/MPI.py").write_text("print('a warning of MPI')\n")
        site.joinpath("petsc4py/PETSc.py").write_text("ScalarType = RealType = float\n")
        digits = tuple(map(int, version.split(".")))
        site.joinpath("sitecustomize.py").write_text(f"import sys\nsys.version_info = {digits}\n")
        real = Path(sys.base_prefix, "bin/python3")
        return self.executable(place, f'PYTHONPATH={site} exec {real} "$@"')

    def setup(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the set-up script there."""
        variables = {"HOME": str(self.root), "PATH": os.pathsep.join(map(str, self.path))}
        return subprocess.run(
            [self.checkout / "tools/setup.sh", *arguments],
            env=variables | self.variables,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
        )

    def interpreter(self) -> str:
        """The route and the interpreter that the set-up script chooses."""
        done = self.setup("--interpreter")
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def refusal(self, *arguments: str) -> str:
        """The one line with which the set-up script refuses."""
        done = self.setup(*arguments)
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        return line


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_newest_python_on_path(machine: Machine) -> None:
    machine.python("bin/python3", "3.11")
    machine.python("bin/python3.12", "3.12")
    python = machine.python("bin/python3.13", "3.13")
    assert machine.interpreter() == f"wheel {python}"


def test_shim_that_exists_but_does_not_run(machine: Machine) -> None:
    machine.executable(
        "bin/python3.13", "echo 'pyenv: python3.13: command not found' >&2; exit 127"
    )
    machine.executable("bin/python3.14", "exit 0")
    python = machine.python("bin/python3.12", "3.12")
    assert machine.interpreter() == f"wheel {python}"


def test_pyenv_versions_newest_first(machine: Machine) -> None:
    machine.python("bin/python3", "3.9")
    machine.python("pyenv/versions/3.9.18/bin/python3", "3.9")
    machine.python("pyenv/versions/3.12.1/bin/python3", "3.12")
    python = machine.python("pyenv/versions/3.13.0/bin/python3", "3.13")
    machine.variables["PYENV_ROOT"] = str(machine.root / "pyenv")
    assert machine.interpreter() == f"wheel {python}"


def test_dolfinx_of_the_machine_goes_before_a_newer_python(machine: Machine) -> None:
    machine.python("bin/python3.14", "3.14")
    python = machine.python("bin/python3", "3.13", dolfinx="0.11.0.post0")
    assert machine.interpreter() == f"system {python}"


def test_dolfinx_behind_another_python3_on_path(machine: Machine) -> None:
    machine.python("bin/python3", "3.14")
    machine.path.append(machine.root / "usr")
    python = machine.python("usr/python3", "3.13", dolfinx="0.11.1")
    assert machine.interpreter() == f"system {python}"


@pytest.mark.parametrize("version", ["0.9.0", "0.10.0.post4", "0.12.0", "0.110.0"])
def test_dolfinx_of_another_version_is_not_used(machine: Machine, version: str) -> None:
    python = machine.python("bin/python3", dolfinx=version)
    assert machine.interpreter() == f"wheel {python}"


def test_wheel_in_another_environment_is_not_used(machine: Machine) -> None:
    python = machine.python("bin/python3", dolfinx="0.11.0.post0")
    installed = machine.root / "site/bin/python3/dolfinx_solver_real-0.11.0.post0.dist-info"
    installed.mkdir()
    installed.joinpath("METADATA").write_text("Name: dolfinx-solver-real\n")
    assert machine.interpreter() == f"wheel {python}"


def test_uv_is_asked_last(machine: Machine) -> None:
    machine.python("bin/python3", "3.11")
    python = machine.python("uv/python3.13", "3.13")
    machine.executable(
        "bin/uv",
        f'[ "$1 $2" = "python find" ] && [ -e {machine.root}/got ] && echo {python} && exit\n'
        f'[ "$1 $2" = "python install" ] && > {machine.root}/got',
    )
    assert machine.interpreter() == f"wheel {python}"


def test_named_interpreter_is_used_alone(machine: Machine) -> None:
    machine.python("bin/python3", dolfinx="0.11.0")
    python = machine.python("elsewhere/python", "3.12")
    machine.variables["PYTHON"] = str(python)
    assert machine.interpreter() == f"wheel {python}"
    machine.variables["PYTHON"] = str(machine.python("old/python", "3.10"))
    assert "is Python 3.10; CPython 3.12 or later" in machine.refusal("--interpreter")
    machine.variables["PYTHON"] = "/no/such/python"
    assert "PYTHON=/no/such/python does not exist" in machine.refusal("--interpreter")


def test_no_python(machine: Machine) -> None:
    machine.python("bin/python3", "3.11")
    assert "no CPython 3.12 or later" in machine.refusal()


def test_no_compiler(machine: Machine) -> None:
    machine.python("bin/python3")
    machine.variables["CC"] = "cc"
    assert "no C compiler, which forms need: 'cc' does not compile" in machine.refusal()


def test_no_headers(machine: Machine) -> None:
    machine.python("bin/python3")
    machine.variables["CC"] = str(
        machine.executable("bin/cc", 'case " $* " in *" -fsyntax-only "*) exit 1 ;; esac; exit 0')
    )
    assert "no Python.h" in machine.refusal()


def test_old_glibc(machine: Machine) -> None:
    machine.python("bin/python3")
    machine.path[0].joinpath("getconf").unlink()
    machine.executable("bin/getconf", "echo glibc 2.31")
    assert "needs glibc 2.34 or later (Debian 12, Ubuntu 22.04), here is 2.31" in machine.refusal()
