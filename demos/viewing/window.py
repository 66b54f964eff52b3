"""`mixed-fem view` on a screen: the mouse turns the body, a slider goes through time."""

from __future__ import annotations

from demos.viewing.results import Results
from demos.viewing.stage import Stage

INTERVAL = 50  # [ms] between two states


def show(stage: Stage, results: Results) -> None:
    """Open the window; return when it is closed.

    The space bar plays and stops, the arrow keys go a step on or back.

    Args:
        stage: What is shown.
        results: Where it comes from.
    """
    last = stage.states - 1
    shown = {"k": last, "playing": False}
    plotter = stage.plotter

    def at(k: int) -> None:
        shown["k"] = min(max(k, 0), last)
        stage.show(shown["k"])

    slider = plotter.add_slider_widget(
        lambda value: at(round(value)), (0, max(last, 1)), value=last, title="", fmt="%.0f",
        pointa=(0.3, 0.93), pointb=(0.7, 0.93), style="modern",
    )  # fmt: skip

    def go(k: int) -> None:
        at(k)
        slider.GetRepresentation().SetValue(shown["k"])
        plotter.render()

    def tick(_: int) -> None:
        if shown["playing"]:
            go((shown["k"] + 1) % stage.states)

    plotter.add_key_event("space", lambda: shown.update(playing=not shown["playing"]))
    plotter.add_key_event("Right", lambda: go(shown["k"] + 1))
    plotter.add_key_event("Left", lambda: go(shown["k"] - 1))
    plotter.add_timer_event(max_steps=2**31 - 1, duration=INTERVAL, callback=tick)
    plotter.show(title=f"mixed-fem: {results.folder}")
