"""Scene files: TOML in, frozen dataclasses out, everything checked before anything is built.

Units are SI. No string of a scene is ever evaluated as code.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

from demos.app import keys
from demos.app.baselines import Baseline, baselines
from demos.app.start import Start
from demos.app.tables import SceneError, Table, flat, suggestion
from forms import (
    FORMULATIONS,
    LOADS,
    MATERIALS,
    MOTIONS,
    SCHEMES,
    Gravity,
    HalfSpace,
    Load,
    Material,
    Motion,
    Rayleigh,
)
from meshes import CELLS, GEOMETRIES
from solvers import SOLVERS, STRATEGIES, StepControl

BUILT_IN = Path(__file__).parents[1] / "scenes"


@dataclass(frozen=True)
class MeshSource:
    """Where the mesh comes from: a file, a named geometry, or a box at the origin.

    Attributes:
        file: The file.
        geometry: A name in `meshes.GEOMETRIES`.
        h: Size of an element of a geometry, by default its own.
        size: Edge lengths of the box.
        cells: Its cells along each edge.
        cell: Their kind.
        refine: How many times each cell is cut into 2ᵈ.
        scale: Metres in a unit of all lengths above and of the file.
    """

    file: Path | None = None
    geometry: str | None = None
    h: float | None = None
    size: tuple[float, ...] = ()
    cells: tuple[int, ...] = ()
    cell: str | None = None
    refine: int = 0
    scale: float = 1.0


@dataclass(frozen=True)
class Region:
    """The cells with a tag, or without a tag all cells, and what they are made of.

    Attributes:
        name: Of the material, in `forms.MATERIALS`.
        material: The material.
        rho: Density. [kg/m³]
        tag: The tag.
    """

    name: str
    material: Material
    rho: float
    tag: int | str | None = None


@dataclass(frozen=True)
class Boundary:
    """A motion, and where in the file it stands."""

    place: str
    motion: Motion


@dataclass(frozen=True)
class Loading:
    """A load, and where in the file it stands."""

    place: str
    load: Load


@dataclass(frozen=True)
class Scene:
    """A complete, valid description of a run.

    Attributes:
        name: Stem of the scene file.
        source: The file as the user named it, for messages.
        description: One line for `mixed-fem list`.
        mesh: The body.
        regions: One for all cells, or one for each cell tag.
        boundaries: Motions of parts of the body; none leaves it free.
        loads: What acts on it; none for weightlessness.
        h: Time step. [s]
        steps: Number of steps.
        scheme: Time stepping scheme.
        scheme_keys: Its parameters.
        control: How h changes on the way, or None.
        damping: Rayleigh damping.
        start: The state at t = 0.
        folder: What paths in the file are relative to.
        formulation: Which Lagrangian.
        degree: Of the displacement.
        solver: Which solver of the Newton system.
        globalisation: What keeps Newton's method from diverging; None for the solver's choice.
        baselines: Other methods to run after, for comparison.
        keys: All keys of the file by their places, such as "time.h", those of the command line
            among them.
        text: Of the file.
    """

    name: str
    source: str
    description: str
    mesh: MeshSource
    regions: tuple[Region, ...]
    boundaries: tuple[Boundary, ...]
    loads: tuple[Loading, ...]
    h: float
    steps: int
    scheme: str
    scheme_keys: Mapping[str, Any]
    control: StepControl | None
    damping: Rayleigh
    start: Start
    folder: Path
    formulation: str
    degree: int
    solver: str
    globalisation: str | None
    baselines: tuple[Baseline, ...]
    keys: Mapping[str, Any]
    text: str = ""

    @property
    def gravity(self) -> tuple[float, ...]:
        """Acceleration [m/s²], d entries; none at all where no load is gravity."""
        loads = [given.load for given in self.loads]
        return tuple(map(sum, zip(*(g.g for g in loads if isinstance(g, Gravity)), strict=False)))


@dataclass(frozen=True)
class Overrides:
    """Settings of the command line, which win over those of the scene file."""

    steps: int | None = None
    formulation: str | None = None
    material: str | None = None
    solver: str | None = None

    def keys(self) -> dict[str, Any]:
        """Those that are given, by their places in a scene."""
        places = {
            "time.steps": self.steps,
            "solve.formulation": self.formulation,
            "material": self.material,
            "solve.solver": self.solver,
        }
        return {place: value for place, value in places.items() if value is not None}


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
    text, path = read_text(comm, scene)
    return parse(text, path, overrides, source=scene)


def read_text(comm: MPI.Comm, scene: str) -> tuple[str, Path]:
    """The text of a scene and the file that it stands in. Collective.

    Raises:
        SceneError: On all ranks: it cannot be read.
    """
    builtin = built_in()
    path = builtin.get(scene, Path(scene))
    text, error = None, None
    if comm.rank == 0:
        try:
            text = path.read_text(encoding="utf-8-sig")
        except FileNotFoundError:
            known = f"{suggestion(scene, builtin)}; built-in scenes: {', '.join(builtin)}"
            error = f"{scene}: neither a built-in scene nor a file{known}"
        except OSError as e:
            error = f"{scene}: cannot be read ({e.strerror})"
        except UnicodeDecodeError:
            error = f"{scene}: not a text file; a scene is written in TOML"
        except ValueError as e:
            error = f"{scene!r}: no name of a file ({e})"
    text, error = comm.bcast((text, error))
    if text is None:
        raise SceneError(error)
    return text, path


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
    scene = build(as_tables(text, source), path, overrides, source)
    return replace(scene, text=text)


def as_tables(text: str, source: str) -> dict[str, Any]:
    """TOML as Python has it.

    Raises:
        SceneError: It is none.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise SceneError(f"{source}: not valid TOML: {e}") from e
    except RecursionError as e:
        raise SceneError(f"{source}: not valid TOML: nested too deeply") from e


def build(data: dict[str, Any], path: Path, overrides: Overrides, source: str) -> Scene:
    """Check the tables of a scene, see `parse`."""
    root = Table(source, "", data)
    description = root.text("description", "")
    mesh = _mesh(root.table("mesh"), path.parent)
    regions = _regions(root.tables("material", required=True), overrides)
    boundaries = tuple(_boundary(table) for table in root.tables("boundary"))
    loads = _loads(root)
    time = root.table("time")
    time.override("steps", overrides.steps, "--steps")
    h = time.positive("h", "a time step in seconds")
    steps = time.count("steps")
    available = keys.offered(SCHEMES)
    scheme = time.choice("scheme", available, "backward-euler")
    scheme_keys = keys.read(time, available[scheme])
    control = _control(time, always=not available[scheme].inertial)
    time.close()
    damping = keys.made(root.table("damping", required=False), Rayleigh)
    start = keys.made(root.table("start", required=False), Start)
    solve = root.table("solve", required=False)
    solve.override("formulation", overrides.formulation, "--formulation")
    solve.override("solver", overrides.solver, "--solver")
    formulation = solve.choice("formulation", FORMULATIONS, "symmetric")
    degree = solve.count("degree", 1)
    solver = solve.choice("solver", SOLVERS, "condensed")
    globalisation = solve.choice("globalisation", STRATEGIES, "") or None
    others = baselines(solve)
    solve.close()
    root.close()
    return Scene(
        name=path.stem,
        source=source,
        description=description,
        mesh=mesh,
        regions=regions,
        boundaries=boundaries,
        loads=loads,
        h=h,
        steps=steps,
        scheme=scheme,
        scheme_keys=scheme_keys,
        control=control,
        damping=damping,
        start=start,
        folder=path.parent,
        formulation=formulation,
        degree=degree,
        solver=solver,
        globalisation=globalisation,
        baselines=others,
        keys={**flat(data), **overrides.keys()},
    )


def _control(time: Table, *, always: bool) -> StepControl | None:
    """Steps of other lengths, where a key asks for them, or always."""
    time.known += ["cuts", "tolerance"]
    tolerance = None
    if "tolerance" in time.data:
        tolerance = time.positive("tolerance", "an error of a step in metres")
    if "cuts" in time.data:
        return StepControl(time.whole("cuts"), tolerance)
    return StepControl(tolerance=tolerance) if always or tolerance is not None else None


def _mesh(table: Table, folder: Path) -> MeshSource:
    kinds = [kind for kind in ("file", "geometry", "box") if kind in table.data]
    if len(kinds) != 1:
        raise table.error(
            'needs either file = "...", geometry = "..." or box = { size = [...], cells = [...] }'
        )
    source = MeshSource(
        refine=table.whole("refine", 0),
        scale=table.positive("scale", "metres in a unit of the mesh", 1.0),
    )
    if kinds == ["file"]:
        file = table.text("file")
        table.close()
        return replace(source, file=folder / file)
    if kinds == ["geometry"]:
        name = table.choice("geometry", GEOMETRIES)
        h = table.positive("h", "a size of elements", GEOMETRIES[name].h)
        table.close()
        return replace(source, geometry=name, h=h)
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
    return replace(source, size=size, cells=tuple(int(n) for n in cells), cell=cell)


def _regions(tables: list[Table], overrides: Overrides) -> tuple[Region, ...]:
    regions: list[Region] = []
    available = keys.offered(MATERIALS)
    for table in tables:
        table.override("name", overrides.material, "--material")
        name = table.choice("name", available)
        E = table.positive("E", "a Young's modulus in Pa")
        nu = table.number("nu")
        if not -1 < nu < 0.5:
            table.fail("nu", "must lie between -1 and 0.5, both excluded")
        rho = table.positive("rho", "a density in kg/m³")
        tag = table.tag("tag") if "tag" in table.data or len(tables) > 1 else None
        if tag in [region.tag for region in regions]:
            table.fail("tag", "names cells that already have a material")
        material = keys.made(table, available[name], {"E": E, "nu": nu})
        regions.append(Region(name, material, rho, tag))
    return tuple(regions)


def _boundary(table: Table) -> Boundary:
    available = keys.offered(MOTIONS)
    motion = table.choice("motion", available)
    return Boundary(table.place, keys.made(table, available[motion]))


def _loads(root: Table) -> tuple[Loading, ...]:
    """Gravity of a table [load], or what the tables [[load]] say, then each [[contact]]."""
    contacts = tuple(
        Loading(table.place, keys.made(table, HalfSpace)) for table in root.tables("contact")
    )
    if isinstance(root.data.get("load"), list):
        return tuple(_load(table) for table in root.tables("load")) + contacts
    table = root.table("load", required=False)
    gravity = table.numbers("gravity", ())
    weight: tuple[Loading, ...] = ()
    if gravity:
        given = {"g": gravity}
        weight = (Loading(f"{table.place} gravity", keys.made(table, Gravity, given)),)
    table.close()
    return weight + contacts


def _load(table: Table) -> Loading:
    available = keys.offered(LOADS)
    kind = table.choice("kind", available)
    return Loading(table.place, keys.made(table, available[kind]))
