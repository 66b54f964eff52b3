"""Scene files: TOML in, frozen dataclasses out, everything checked before anything is built.

Units are SI. No string of a scene is ever evaluated as code.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

from demos.tables import SceneError, Table, suggestion
from forms import FORMULATIONS, MATERIALS, BackwardEuler
from meshes import CELLS, Where
from solvers import SOLVERS

BUILT_IN = Path(__file__).parent / "scenes"

SCHEMES = {"backward-euler": BackwardEuler}
KERNELS = {
    "auto": "compiled where there are some and numba is installed, elsewhere ufl (default)",
    "compiled": "the package's own numba kernels; refused where there are none",
    "ufl": "what UFL and FFCx make of the energy, for any energy; the slow one",
}
MOTIONS = {"fixed": "held where they are"}
# Planned names: refused as not there yet, so that none is mistaken for a misspelling.
MOTIONS_TO_COME = ("stretch", "twist", "bend", "translate")
SCHEMES_TO_COME = ("bdf2", "static")


@dataclass(frozen=True)
class MeshSource:
    """Where the mesh comes from: a file, or a box at the origin with `size` [m] and `cells`."""

    file: Path | None = None
    size: tuple[float, ...] = ()
    cells: tuple[int, ...] = ()
    cell: str | None = None


@dataclass(frozen=True)
class Material:
    """Strain energy, Young's modulus E [Pa], Poisson's ratio, density [kg/m³] of cells with a tag.

    Without a tag, of all cells.
    """

    name: str
    E: float
    nu: float
    rho: float
    tag: int | None = None


@dataclass(frozen=True)
class Boundary:
    """A set of vertices and what they do."""

    where: Where
    motion: str


@dataclass(frozen=True)
class Scene:
    """A complete, valid description of a run.

    Attributes:
        name: Stem of the scene file.
        source: The file as the user named it, for messages.
        description: One line for `mixed-fem list`.
        mesh: The body.
        materials: One for all cells, or one for each cell tag.
        boundaries: Constrained vertex sets; none leaves the body free.
        gravity: Acceleration, d entries, or none at all for weightlessness. [m/s²]
        h: Time step. [s]
        steps: Number of steps.
        scheme: Time stepping scheme.
        formulation: Which Lagrangian.
        degree: Of the displacement.
        solver: Which solver of the Newton system.
        kernels: What evaluates the Newton system, a name in `KERNELS`.
        baseline: A formulation to run after, for comparison.
    """

    name: str
    source: str
    description: str
    mesh: MeshSource
    materials: tuple[Material, ...]
    boundaries: tuple[Boundary, ...]
    gravity: tuple[float, ...]
    h: float
    steps: int
    scheme: str
    formulation: str
    degree: int
    solver: str
    kernels: str
    baseline: str | None


@dataclass(frozen=True)
class Overrides:
    """Settings of the command line, which win over those of the scene file."""

    steps: int | None = None
    formulation: str | None = None
    material: str | None = None
    solver: str | None = None


def built_in() -> dict[str, Path]:
    """The built-in scenes by name."""
    return {path.stem: path for path in sorted(BUILT_IN.glob("*.toml"))}


def load(comm: MPI.Comm, scene: str, overrides: Overrides = Overrides()) -> Scene:
    """Read and check a scene.

    Args:
        comm: The file is read on rank 0 of it, and parsed on all ranks.
        scene: Name of a built-in scene, or path of a TOML file.
        overrides: Settings that replace those of the file.

    Raises:
        SceneError: On all ranks. One line that names the file, the key, what is wrong and what
            would be right.
    """
    builtin = built_in()
    path = builtin.get(scene, Path(scene))
    text, error = None, None
    if comm.rank == 0:
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            known = f"{suggestion(scene, builtin)}; built-in scenes: {', '.join(builtin)}"
            error = f"{scene}: neither a built-in scene nor a file{known}"
        except OSError as e:
            error = f"{scene}: cannot be read ({e.strerror})"
        except UnicodeDecodeError:
            error = f"{scene}: not a text file; a scene is written in TOML"
    text, error = comm.bcast((text, error))
    if error is not None:
        raise SceneError(error)
    return parse(text, path, overrides, source=scene)


def parse(
    text: str, path: Path, overrides: Overrides = Overrides(), source: str | None = None
) -> Scene:
    """Check the text of a scene.

    Args:
        text: TOML.
        path: The file it stands in: names the scene, and its mesh file is relative to it.
        overrides: Settings that replace those of the file.
        source: How messages call the file; by default its path.

    Raises:
        SceneError: See `load`.
    """
    source = str(path) if source is None else source
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise SceneError(f"{source}: not valid TOML: {e}") from e
    root = Table(source, "", data)
    description = root.text("description", "")
    mesh = _mesh(root.table("mesh"), path.parent)
    materials = _materials(root.tables("material", required=True), overrides)
    boundaries = tuple(_boundary(table) for table in root.tables("boundary"))
    load_table = root.table("load", required=False)
    gravity = load_table.numbers("gravity", ())
    if gravity and mesh.file is None and len(gravity) != len(mesh.size):
        load_table.fail("gravity", f"must have {len(mesh.size)} entries, as the box has dimensions")
    load_table.close()
    time = root.table("time")
    time.override("steps", overrides.steps, "--steps")
    h = time.positive("h", "a time step in seconds")
    steps = time.count("steps")
    scheme = time.choice("scheme", SCHEMES, "backward-euler", later=SCHEMES_TO_COME)
    time.close()
    solve = root.table("solve", required=False)
    solve.override("formulation", overrides.formulation, "--formulation")
    solve.override("solver", overrides.solver, "--solver")
    formulation = solve.choice("formulation", FORMULATIONS, "symmetric")
    degree = solve.count("degree", 1)
    solver = solve.choice("solver", SOLVERS, "condensed")
    kernels = solve.choice("kernels", KERNELS, "auto")
    baseline = solve.choice("baseline", FORMULATIONS, "") or None
    solve.close()
    root.close()
    return Scene(
        name=path.stem,
        source=source,
        description=description,
        mesh=mesh,
        materials=materials,
        boundaries=boundaries,
        gravity=gravity,
        h=h,
        steps=steps,
        scheme=scheme,
        formulation=formulation,
        degree=degree,
        solver=solver,
        kernels=kernels,
        baseline=baseline,
    )


def _mesh(table: Table, folder: Path) -> MeshSource:
    if "geometry" in table.data:
        table.fail("geometry", "named geometries are not available yet; available: file, box")
    if ("file" in table.data) == ("box" in table.data):
        raise table.error('needs either file = "..." or box = { size = [...], cells = [...] }')
    if "file" in table.data:
        file = table.text("file")
        table.close()
        return MeshSource(file=folder / file)
    box = table.table("box")
    table.close()
    size = box.numbers("size")
    cells = box.numbers("cells")
    cell = box.choice("cell", CELLS.get(len(size), ()), "") or None
    box.close()
    if len(size) not in (2, 3) or min(size) <= 0:
        box.fail("size", "must be 2 or 3 positive lengths in metres")
    if len(cells) != len(size) or any(n < 1 or n != int(n) for n in cells):
        box.fail("cells", f"must be {len(size)} whole numbers of 1 or more, one for each length")
    return MeshSource(size=size, cells=tuple(int(n) for n in cells), cell=cell)


def _materials(tables: list[Table], overrides: Overrides) -> tuple[Material, ...]:
    materials: list[Material] = []
    for table in tables:
        table.override("name", overrides.material, "--material")
        name = table.choice("name", MATERIALS)
        E = table.positive("E", "a Young's modulus in Pa")
        nu = table.number("nu")
        if not -1 < nu < 0.5:
            table.fail("nu", "must lie between -1 and 0.5, both excluded")
        rho = table.positive("rho", "a density in kg/m³")
        tag = table.tag("tag") if "tag" in table.data or len(tables) > 1 else None
        if tag in [m.tag for m in materials]:
            table.fail("tag", "names cells that already have a material")
        table.close()
        materials.append(Material(name, E, nu, rho, tag))
    return tuple(materials)


def _boundary(table: Table) -> Boundary:
    motion = table.choice("motion", MOTIONS, later=MOTIONS_TO_COME)
    clause = table.value("where")
    try:
        where = Where.parse(clause)
    except ValueError as e:
        raise table.error(f"where: {e}") from e
    table.close()
    return Boundary(where, motion)
