"""A picture of a deformed body, coloured by |S - I|, over the outline of its rest shape.

Drawing happens in a process of its own: where a machine has no EGL, VTK does not raise but
crashes, and inside a run under MPI that would take the results with it. This file is therefore
also the program of that process, and imports nothing of the project.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

SIZE = (1600, 900)
TIMEOUT = 120  # [s]
INK = "#22303c"
COLOURS = "magma_r"
FONT_FILE = 4  # VTK_FONT_FILE

Array = npt.NDArray[np.float64]


def draw(
    results: Path, picture: Path, *, up: Sequence[float] = (), caption: str = ""
) -> str | None:
    """Draw the final state of a run.

    Args:
        results: The `final.npz` of the run.
        picture: The PNG to write.
        up: Direction that points upwards in the picture, d entries; by default the last axis.
        caption: Text below the body.

    Returns:
        None, or in one line why this machine could not draw.
    """
    command = [sys.executable, "-P", __file__, str(results), str(picture), "--caption", caption]
    command += [f"--up={','.join(map(str, up))}"] if any(up) else []
    # The process must not take itself for a rank of the run that started it.
    launcher = ("PMI", "PMIX", "MPI", "HYD", "OMPI")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(launcher)}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return f"drawing took longer than {TIMEOUT} s"
    if done.returncode == 0:
        return None
    if "No module named 'pyvista'" in done.stderr:
        return "pyvista is not installed"
    if done.returncode < 0:
        return f"VTK cannot render here, it died of signal {-done.returncode}; is libEGL installed?"
    said = done.stderr.strip().splitlines()
    return said[-1] if said else f"drawing ended with exit code {done.returncode}"


def _main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Draw the final state of a run.")
    parser.add_argument("results", type=Path, help="final.npz of a run")
    parser.add_argument("picture", type=Path, help="the PNG to write")
    parser.add_argument("--up", default="", help="upward direction, comma separated")
    parser.add_argument("--caption", default="", help="text below the body")
    given = parser.parse_args(arguments)
    with np.load(given.results) as data:
        X, x, S, cells = (data[key] for key in ("X", "x", "S", "cells"))
    strain = np.linalg.norm(S - np.eye(S.shape[-1]), axis=(1, 2))
    up = np.array(given.up.split(","), dtype=np.float64) if given.up else np.empty(0)
    _render(X, x, cells, strain, up, given.caption, given.picture)


def _render(
    X: Array, x: Array, cells: npt.NDArray[np.int64], strain: Array, up: Array, caption: str,
    picture: Path,
) -> None:  # fmt: skip
    from matplotlib import get_data_path

    pv: Any = importlib.import_module("pyvista")

    # VTK's own fonts have neither the minus sign nor Greek letters.
    font = str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
    planar = X.shape[1] == 2
    step, ticks = _ticks(float(strain.max()))
    body, rest = _surface(pv, x, cells), _surface(pv, X, cells)
    body.cell_data["strain"] = strain[body.cell_data["cell"]]
    plotter = pv.Plotter(off_screen=True, window_size=list(SIZE))
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    actor = plotter.add_mesh(
        body,
        scalars="strain",
        cmap=COLOURS,
        clim=(0.0, step * ticks),
        lighting=not planar,
        ambient=0.72,
        diffuse=0.34,
        show_edges=True,
        edge_color=INK,
        edge_opacity=0.25,
        line_width=1.0,
        show_scalar_bar=False,
    )
    outline = rest.extract_feature_edges(
        feature_angle=20,
        boundary_edges=True,
        feature_edges=not planar,
        manifold_edges=False,
        non_manifold_edges=False,
    )
    plotter.add_mesh(outline, color="#8a96a3", line_width=3.0, lighting=False)
    bar = plotter.add_scalar_bar(
        mapper=actor.mapper,
        title="",
        vertical=True,
        color=INK,
        label_font_size=28,
        n_labels=ticks + 1,
        fmt="%.3g",
        width=0.035,
        height=0.56,
        position_x=0.9,
        position_y=0.2,
    )
    bar.label_text_property.SetFontFamily(FONT_FILE)
    bar.label_text_property.SetFontFile(font)
    bar.SetTextPad(6)
    for text, place, size in (
        ("\N{DIVIDES}S \N{MINUS SIGN} I\N{DIVIDES}", (0.895, 0.8), 18),
        (caption, (0.03, 0.045), 15),
    ):
        if text:
            plotter.add_text(
                text, position=place, viewport=True, font_size=size, color=INK, font_file=font
            )
    _aim(plotter, np.vstack([rest.points, body.points]), up, planar)
    plotter.screenshot(str(picture))
    plotter.close()


def _ticks(largest: float) -> tuple[float, int]:
    """A round step, and how many of them cover the values from 0 to the largest."""
    wanted = max(largest, 1e-12) / 6
    power = 10.0 ** np.floor(np.log10(wanted))
    step = next(f * power for f in (1.0, 2.0, 2.5, 5.0, 10.0) if f * power >= wanted)
    return step, max(int(np.ceil(largest / step)), 1)


# Faces of a tetrahedron and of VTK's hexahedron, each seen from outside if the edges from the first
# vertex to those of _EDGES have a positive determinant.
_FACES = {
    4: [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]],
    8: [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
}
_EDGES = {4: [1, 2, 3], 8: [1, 3, 4]}


def _surface(pv: Any, points: Array, cells: npt.NDArray[np.int64]) -> Any:
    """The faces that one sees, all wound the same way, each with the number of its cell."""
    padded = np.zeros((len(points), 3))
    padded[:, : points.shape[1]] = points
    number = np.arange(len(cells))
    faces = cells
    if points.shape[1] == 3:
        of_cell = np.array(_FACES[cells.shape[1]])
        edges = padded[cells[:, _EDGES[cells.shape[1]]]] - padded[cells[:, :1]]
        faces = cells[:, of_cell]
        inverted = np.linalg.det(edges) < 0
        faces[inverted] = faces[inverted][..., ::-1]
        faces, number = faces.reshape(-1, of_cell.shape[1]), np.repeat(number, len(of_cell))
        _, first, count = np.unique(np.sort(faces), axis=0, return_index=True, return_counts=True)
        outer = first[count == 1]
        faces, number = faces[outer], number[outer]
    surface = pv.PolyData.from_regular_faces(padded, faces)
    surface.cell_data["cell"] = number
    return surface


def _aim(plotter: Any, points: Array, up: Array, planar: bool) -> None:
    """Look across the longest horizontal extent, a little from above, and fill the frame."""
    if planar:
        direction, upward = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    else:
        upward = up / np.linalg.norm(up) if len(up) else np.array([0.0, 0.0, 1.0])
        longest = np.eye(3)[np.argsort(-np.ptp(points, axis=0), kind="stable")]
        across = next(axis for axis in longest if abs(axis @ upward) < 0.9)
        across = across - (across @ upward) * upward
        across /= np.linalg.norm(across)
        direction = np.cross(across, upward) + 0.35 * across + 0.3 * upward
        direction /= np.linalg.norm(direction)
    right = np.cross(upward, direction)
    right /= np.linalg.norm(right)
    frame = np.array([right, np.cross(direction, right)])
    flat = points @ frame.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    # The body gets the part of the window that the bar and the caption leave.
    left, bottom, width, height = 0.04, 0.14, 0.82, 0.8
    aspect = SIZE[0] / SIZE[1]
    scale = max((high - low)[0] / (width * aspect), (high - low)[1] / height)
    offset = np.array([(0.5 - left - width / 2) * aspect, 0.5 - bottom - height / 2]) * scale
    centre = (0.5 * (low + high) + offset) @ frame
    centre = centre + (points.mean(axis=0) @ direction) * direction
    away = 10 * float(np.linalg.norm(np.ptp(points, axis=0)))
    plotter.enable_parallel_projection()
    plotter.camera_position = [centre + away * direction, centre, frame[1]]
    plotter.camera.parallel_scale = scale / 2
    plotter.renderer.reset_camera_clipping_range()


if __name__ == "__main__":
    _main()
