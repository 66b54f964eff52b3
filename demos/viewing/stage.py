"""A deformed body over time, coloured by a field, over the outline of its rest shape."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from demos.viewing.colours import FIELDS, Field
from demos.viewing.results import Results, padded

SIZE = (1600, 900)
INK = "#22303c"
COLOURS = "magma_r"
FONT_FILE = 4  # VTK_FONT_FILE
CLEAR = 0.75  # of its size, by which a body has moved away
MOST_LOOKED_AT = 20
MOVIE_SECONDS = 8.0  # longest, of runs with many states

Array = npt.NDArray[np.float64]


class Stage:
    """A PyVista plotter with the body in it. One range of colours and one camera serve all states.

    Attributes:
        plotter: The plotter.
        states: How many states can be shown.
    """

    def __init__(
        self,
        results: Results,
        field: str = "strain",
        *,
        only: int | None = None,
        window: bool = False,
    ) -> None:
        """Set the stage, with the last state on it.

        Args:
            results: What is shown.
            field: Name of the colour, one of `FIELDS`.
            only: Number of the one state that will be shown, with those before from which the body
                has moved away; they alone set colours and camera.
            window: Whether to show it on the screen.

        Raises:
            ResultsError: The field is unknown, or its file cannot be read.
        """
        # VTK's own fonts have neither the minus sign nor Greek letters.
        from matplotlib import get_data_path

        self._pv: Any = importlib.import_module("pyvista")
        self._font = str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
        self._results, self._name = results, field
        self.states = len(results)
        self._up = np.array(results.about.get("gravity", ()), dtype=np.float64) * -1.0
        trail = [] if only is None else _on_the_way(results, only % self.states)
        values, extremes = [], []
        for last in trail or results:
            values.append(results.field_of(last, field))
            extremes.append(_extremes(padded(last["x"])))
        self._planar = last["X"].shape[1] == 2
        self._body = _surface(self._pv, last["X"], last["cells"])
        self._rest = self._body.copy()
        self._space = np.vstack([self._rest.points, *extremes])
        self.plotter = self._pv.Plotter(off_screen=not window, window_size=list(SIZE))
        self.plotter.set_background("white")
        self.plotter.enable_anti_aliasing("ssaa")
        self._time = self._text("", (0.03, 0.045), 15)
        self._put(last, values[-1])
        low = float(min(v.min() for v in values))
        scale = _ticks(low if field == "stretch" else min(low, 0.0), max(v.max() for v in values))
        self._add_bar(self._add_body(self._body, scale), FIELDS[field], scale[2])
        for state, colour in zip(trail[:-1], values, strict=False):
            former = self._body.copy()
            self._dress(former, state, colour)
            self._add_body(former, scale)
        self._add_surroundings()
        _aim(self.plotter, self._space, self._up if any(self._up) else np.empty(0), self._planar)

    def show(self, k: int) -> None:
        """Put a state on the stage."""
        state = self._results[k]
        self._put(state, self._results.field_of(state, self._name))

    def picture(self, path: Path) -> None:
        """Write what is seen as a PNG."""
        self.plotter.screenshot(str(path))

    def movie(self, path: Path) -> None:
        """Write all states as an mp4 or gif, in their own time unless that is long or none.

        Args:
            path: Whose suffix says which.
        """
        length = float(np.clip(np.ptp(self._results.times), 1.0, MOVIE_SECONDS))
        rate = float(np.clip(self.states / length, 1.0, 60.0))
        if path.suffix == ".gif":
            self.plotter.open_gif(str(path), fps=max(round(rate), 1), loop=0)
        else:
            self.plotter.open_movie(str(path), framerate=max(round(rate), 1), macro_block_size=4)
        for k in range(self.states):
            self.show(k)
            self.plotter.write_frame()
        self.plotter.close()

    def _put(self, state: dict[str, Any], values: Array) -> None:
        self._dress(self._body, state, values)
        caption = self._results.about.get("caption", "")
        self._time.input = f"{caption}   t = {float(state['t']):.3f} s"

    def _dress(self, body: Any, state: dict[str, Any], values: Array) -> None:
        body.points = padded(state["x"])
        if FIELDS[self._name].on == "cells":
            body.cell_data["colour"] = values[body.cell_data["cell"]]
        else:
            body.point_data["colour"] = values

    def _text(self, text: str, place: tuple[float, float], size: int) -> Any:
        return self.plotter.add_text(
            text, position=place, viewport=True, font_size=size, color=INK, font_file=self._font
        )

    def _add_body(self, body: Any, scale: tuple[float, float, int]) -> Any:
        start, step, ticks = scale
        return self.plotter.add_mesh(
            body,
            scalars="colour",
            cmap=COLOURS,
            clim=(start, start + step * ticks),
            lighting=not self._planar,
            ambient=0.72,
            diffuse=0.34,
            show_edges=True,
            edge_color=INK,
            edge_opacity=0.25,
            line_width=1.0,
            show_scalar_bar=False,
        )

    def _add_bar(self, actor: Any, field: Field, ticks: int) -> None:
        bar = self.plotter.add_scalar_bar(
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
        bar.label_text_property.SetFontFile(self._font)
        bar.SetTextPad(6)
        self._text(field.label, (0.88, 0.8), 18)

    def _add_surroundings(self) -> None:
        """The outline at rest, and the planes that the body may meet."""
        outline = self._rest.extract_feature_edges(
            feature_angle=40,  # edges, not the facets of what is round
            boundary_edges=True,
            feature_edges=not self._planar,
            manifold_edges=False,
            non_manifold_edges=False,
        )
        if outline.n_points:
            self.plotter.add_mesh(outline, color="#8a96a3", line_width=3.0, lighting=False)
        if not self._planar:
            self.plotter.add_mesh(self._rest, color="#8a96a3", opacity=0.12, lighting=False)
        for normal, offset in self._results.about.get("planes", ()):
            self.plotter.add_mesh(
                _plane(self._pv, self._space, normal, offset),
                color="#dfe5ea",
                line_width=3.0,
                lighting=False,
            )


def _on_the_way(results: Results, last: int) -> list[dict[str, Any]]:
    """States up to one of them, each clear of the next: a body that flies is seen several times.

    Clear is what has moved as a whole by its own size. Of many states only some are looked at.
    """
    shown = [results[last]]
    for k in np.unique(np.linspace(0, last, min(last, MOST_LOOKED_AT) + 1).astype(int))[-2::-1]:
        state, after = results[k], shown[0]["x"]
        moved = np.linalg.norm(state["x"].mean(axis=0) - after.mean(axis=0))
        if moved > CLEAR * max(np.ptp(x, axis=0).max() for x in (state["x"], after)):
            shown.insert(0, state)
    return shown


def _plane(pv: Any, space: Array, normal: Sequence[float], offset: float) -> Any:
    """The part of the plane n · x = offset below the body, a line in 2D."""
    n = padded(np.array([normal], dtype=np.float64))[0]
    offset, n = offset / np.linalg.norm(n), n / np.linalg.norm(n)
    middle = 0.5 * (space.min(axis=0) + space.max(axis=0))
    centre = middle - (middle @ n - offset) * n
    size = 1.3 * float(np.ptp(space, axis=0).max())
    if len(normal) == 2:
        along = np.array([-n[1], n[0], 0.0]) * size / 2
        return pv.Line(centre - along, centre + along)
    return pv.Plane(center=centre, direction=n, i_size=size, j_size=size)


def _extremes(points: Array) -> Array:
    """The points that lie furthest along each of 13 directions: enough to place a camera."""
    directions = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)]) - 1
    along = points @ directions.T
    return points[np.concatenate([along.argmin(axis=0), along.argmax(axis=0)])]


def _ticks(low: float, high: float) -> tuple[float, float, int]:
    """Where a scale begins, its round step, and how many of them cover the values."""
    wanted = max(high - low, 1e-9 * abs(high), 1e-12) / 6
    power = 10.0 ** np.floor(np.log10(wanted))
    step = next(f * power for f in (1.0, 2.0, 2.5, 5.0, 10.0) if f * power >= wanted)
    start = step * np.floor(low / step)
    return start, step, max(int(np.ceil((high - start) / step)), 1)


# Faces of a tetrahedron and of VTK's hexahedron, each seen from outside if the edges from the first
# vertex to those of _EDGES have a positive determinant.
_FACES = {
    4: [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]],
    8: [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
}
_EDGES = {4: [1, 2, 3], 8: [1, 3, 4]}


def _surface(pv: Any, points: Array, cells: npt.NDArray[np.int64]) -> Any:
    """The faces that one sees, all wound the same way, each with the number of its cell."""
    in_space = padded(points)
    number = np.arange(len(cells))
    faces = cells
    if points.shape[1] == 3:
        of_cell = np.array(_FACES[cells.shape[1]])
        edges = in_space[cells[:, _EDGES[cells.shape[1]]]] - in_space[cells[:, :1]]
        faces = cells[:, of_cell]
        inverted = np.linalg.det(edges) < 0
        faces[inverted] = faces[inverted][..., ::-1]
        faces, number = faces.reshape(-1, of_cell.shape[1]), np.repeat(number, len(of_cell))
        _, first, count = np.unique(np.sort(faces), axis=0, return_index=True, return_counts=True)
        outer = first[count == 1]
        faces, number = faces[outer], number[outer]
    surface = pv.PolyData.from_regular_faces(in_space, faces)
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
