"""`mixed-fem view --web`: the body in a browser, drawn by this process, with a slider for time."""

from __future__ import annotations

import asyncio
import importlib
from typing import Any

from demos.viewing.results import Results
from demos.viewing.stage import Stage

HOST = "127.0.0.1"
INTERVAL = 0.08  # [s] between two states


def serve(stage: Stage, results: Results, port: int) -> None:
    """Serve the page on the loopback address until interrupted.

    Args:
        stage: What is shown.
        results: Where it comes from.
        port: Of the address; 0 for a free one.
    """
    app: Any = importlib.import_module("trame.app")
    layout: Any = importlib.import_module("trame.ui.vuetify3")
    vuetify: Any = importlib.import_module("trame.widgets.vuetify3")
    vtk: Any = importlib.import_module("trame.widgets.vtk")
    server = app.get_server("mixed-fem", client_type="vue3")
    state, control = server.state, server.controller
    last = stage.states - 1
    state.update({"k": last, "playing": False, "trame__title": f"mixed-fem: {results.folder}"})

    @state.change("k")  # type: ignore[untyped-decorator]
    def at(k: int, **_: object) -> None:
        stage.show(int(k))
        control.view_update()

    @state.change("playing")  # type: ignore[untyped-decorator]
    def play(playing: bool, **_: object) -> None:
        if playing:
            asyncio.get_running_loop().create_task(run())

    async def run() -> None:
        while state.playing:
            with state:
                state.k = (int(state.k) + 1) % stage.states
            await asyncio.sleep(INTERVAL)

    with layout.SinglePageLayout(server) as page:
        page.title.set_text(results.name)
        with page.toolbar:
            with vuetify.VBtn(icon=True, id="play", click="playing = !playing"):
                vuetify.VIcon("{{ playing ? 'mdi-pause' : 'mdi-play' }}")
            vuetify.VSlider(v_model=("k",), min=0, max=last, step=1, hide_details=True, id="time")
        page.footer.hide()
        with page.content, vuetify.VContainer(fluid=True, classes="pa-0 fill-height"):
            view = vtk.VtkRemoteView(stage.plotter.render_window, interactive_ratio=1)
            control.view_update = view.update

    def ready(**_: object) -> None:
        print(f"view: http://{HOST}:{server.port} (Ctrl-C ends it)", flush=True)

    control.on_server_ready.add(ready)
    server.start(host=HOST, port=port, open_browser=False, show_connection_info=False, timeout=0)
