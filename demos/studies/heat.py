"""Heat maps of Newton iterations over step and stiffness."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from demos.studies.records import Record, matrix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

MOST = 100


def iterations(
    plot: Axes,
    records: Iterable[Record],
    axis: str,
    value: Callable[[Record], float | None],
) -> AxesImage:
    """Iterations over the step h and a stiffness; what fails is left white.

    Args:
        plot: Where.
        records: Of what.
        axis: Name of the parameter that grows to the right.
        value: Iterations of a record, None if it fails.
    """
    h, stiffness, picture = matrix(records, "h", axis, value)
    for (i, j), number in np.ndenumerate(picture):
        shown = "fails" if np.isnan(number) else f"{number:.1f}"
        plot.text(j, i, shown, ha="center", va="center", fontsize=7)
    image = plot.imshow(
        picture, cmap="viridis_r", norm="log", vmin=1.0, vmax=MOST, aspect="auto", alpha=0.7
    )
    plot.set_xticks(range(len(stiffness)), [f"{value:.0e}" for value in stiffness], fontsize=6)
    plot.set_yticks(range(len(h)), [f"{value:g}" for value in h])
    return image


def colours(figure: Figure, image: AxesImage, plots: Any) -> None:
    """The scale of the colours of all plots."""
    bar = figure.colorbar(image, ax=plots, shrink=0.4, label="Newton iterations a step")
    ticks = [1, 3, 10, 30, MOST]
    bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
