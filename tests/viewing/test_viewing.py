"""The results of a run, as a user reads them, looks at them and serves them to a browser."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy import ndimage

from demos.app.cli import main
from demos.app.viewer import draw
from demos.viewing import FIELDS, Results, ResultsError, load, plot
from tests.browser import chromium

pytestmark = pytest.mark.serial

SCENE = """\
[mesh]
box = { size = [2.0, 1.0, 1.0], cells = [2, 1, 1] }
[[material]]
name = "corotational"
E = 1e5
nu = 0.3
rho = 1000.0
[[boundary]]
where = { x = "min" }
motion = "fixed"
[load]
gravity = [0.0, 0.0, -9.81]
[[contact]]
plane = [0.0, 0.0, 1.0]
offset = -0.2
stiffness = 1e6
[time]
h = 0.05
steps = 4
[solve]
formulation = "symmetric"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Results of a short beam over a floor."""
    path = tmp_path_factory.mktemp("view")
    (path / "beam.toml").write_text(SCENE)
    assert main(["run", str(path / "beam.toml"), "--out", str(path / "out"), "--quiet"]) == 0
    return path / "out"


@pytest.fixture(scope="module")
def results(folder) -> Results:
    return load(folder)


def rendering(folder: Path) -> None:
    """Skip where nothing can be drawn."""
    if (reason := draw(folder, folder / "try.png")) is not None:
        pytest.skip(f"no rendering on this machine: {reason}")


def pixels(path: Path) -> np.ndarray:
    image = pytest.importorskip("matplotlib.image")
    return image.imread(path)[..., :3]


def test_states_are_those_of_the_run(folder, results):
    """In time, in the last state to the last bit, with F = R S for what the cells hold."""
    np.testing.assert_allclose(results.times, 0.05 * np.arange(5))
    last = results[-1]
    with np.load(folder / "final.npz") as final:
        for name in ("x", "v", "von_mises"):
            np.testing.assert_array_equal(last[name], final[name])
        np.testing.assert_allclose(last["S"], final["S"], atol=1e-6)  # kept in single precision
    edges = [
        np.swapaxes(last[name][last["cells"][:, 1:]] - last[name][last["cells"][:, :1]], 1, 2)
        for name in ("x", "X")
    ]
    F = edges[0] @ np.linalg.inv(edges[1])
    np.testing.assert_allclose(last["R"] @ last["S"], F, atol=1e-6)
    volume = np.abs(np.linalg.det(edges[1])) / 6
    elastic = results.history["elastic_energy"].iloc[-1]
    assert volume @ last["psi"] == pytest.approx(elastic, rel=1e-9)


def test_tables_and_summary(results):
    """A row a step and a row an iteration; the summary counts them."""
    assert list(results.history["step"]) == [1, 2, 3, 4]
    iterations = results.newton.groupby("step")["iteration"].max()
    assert list(iterations) == list(results.history["newton_iterations"])
    shown = results._repr_html_()
    assert f"{iterations.sum()}; " in shown
    assert "beam" in shown


@pytest.mark.parametrize("name", FIELDS)
def test_fields(name, results):
    """One number a cell or vertex, zero at rest but for the stretch, which is one."""
    state = results[-1]
    size = len(state["cells" if FIELDS[name].on == "cells" else "x"])
    assert results.field(name).shape == (size,)
    rest = results.field(name, 0)
    np.testing.assert_allclose(rest, 1.0 if name == "stretch" else 0.0, atol=1e-6)
    assert np.ptp(results.field(name)) > 1e-6


def test_other_programs_read_the_files(folder, results):
    """PyVista goes through time; meshio reads each file."""
    pv = pytest.importorskip("pyvista")
    reader = pv.get_reader(folder / "fields" / "fields.pvd")
    assert reader.time_values == pytest.approx(list(results.times))
    reader.set_active_time_value(reader.time_values[-1])
    (block,) = reader.read()
    np.testing.assert_array_equal(block.points, results[-1]["x"])
    file = meshio.read(folder / "fields" / "fields000004.vtu")
    assert set(file.cell_data) >= {"S", "R", "P", "von Mises stress", "tag"}


def test_run_json_repeats_the_run(folder, tmp_path):
    """The scene in it gives the same positions again."""
    about = json.loads((folder / "run.json").read_text())
    assert about["versions"]["dolfinx"].startswith("0.11")
    (tmp_path / "again.toml").write_text(about["text"])
    out = tmp_path / "out"
    assert main(["run", str(tmp_path / "again.toml"), "--out", str(out), "--quiet"]) == 0
    np.testing.assert_array_equal(load(out)[-1]["x"], load(folder)[-1]["x"])


def test_a_body_that_flies_is_seen_on_its_way(folder, tmp_path):
    """At each step where it has moved by more than its size, else only at the last."""
    rendering(folder)
    held, floor = SCENE.index("[[boundary]]"), SCENE.index("[time]")
    for speed, bodies in ((80.0, 5), (0.0, 1)):
        start = f"[start]\nvelocity = [{speed}, 0.0, 5.0]\n"
        scene, out = tmp_path / "thrown.toml", tmp_path / f"{bodies}"
        scene.write_text(SCENE[:held] + start + SCENE[floor:])
        assert main(["run", str(scene), "--out", str(out), "--quiet"]) == 0
        ink = (pixels(out / "picture.png") < 0.9).any(axis=2)[: 900 * 4 // 5, : 1600 * 17 // 20]
        _, sizes = np.unique(ndimage.label(ink)[0], return_counts=True)
        assert (sizes > 500).sum() == 1 + bodies


def test_picture(folder, tmp_path):
    """White ground, ink, and colours; another field and another step are other pictures."""
    rendering(folder)
    seen = []
    for name, more in (("a", []), ("b", ["--field", "speed"]), ("c", ["--step", "1"])):
        path = tmp_path / f"{name}.png"
        assert main(["view", str(folder), "--picture", str(path), *more]) == 0
        seen.append(pixels(path))
        assert seen[-1].shape == (900, 1600, 3)
        white = (seen[-1] > 0.99).all(axis=2)
        assert 0.2 < white.mean() < 0.95
        assert len(np.unique((seen[-1][~white] * 32).astype(int), axis=0)) > 50
    assert not np.array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio's pipes
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_movie(folder, tmp_path, suffix):
    """A frame a state, and not all the same."""
    imageio = pytest.importorskip("imageio.v3")
    rendering(folder)
    path = tmp_path / f"a.{suffix}"
    assert main(["view", str(folder), "--movie", str(path)]) == 0
    frames = list(imageio.imiter(path))
    assert len(frames) == 5
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_plot(folder, results, capsys):
    """Energies, iterations, residuals and reactions, as they are in the tables."""
    pytest.importorskip("matplotlib")
    energies, iterations, residuals, reactions = plot(results).axes
    (kinetic, *_) = energies.lines
    np.testing.assert_array_equal(kinetic.get_ydata(), results.history["kinetic_energy"])
    heights = [bar.get_height() for bar in iterations.patches]
    assert heights == list(results.history["newton_iterations"])
    assert len(residuals.lines) == 4
    assert len(reactions.lines) == 3
    assert main(["plot", str(folder)]) == 0
    assert pixels(folder / "plot.png").std() > 0.05
    assert "plot.png" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "nowhere"], "nowhere: has no results of mixed-fem run"),
        (["plot", "nowhere"], "nowhere: has no results of mixed-fem run"),
        (["view", "OUT", "--picture", "a.jpg"], r"--picture a\.jpg: must end in \.png"),
        (["view", "OUT", "--movie", "a.avi"], r"--movie a\.avi: must end in \.mp4 or \.gif"),
        (["view", "OUT", "--picture", "a.png", "--step", "9"], "the run has steps 0 to 4"),
        (["view", "OUT", "--step", "1"], "--step 1: goes with --picture"),
        (["view", "OUT", "--field", "heat"], "invalid choice: 'heat'"),
        (["view", "OUT", "--web", "--movie", "a.gif"], "not allowed with argument"),
        (["view", "OUT"], "no display here; use --web"),
        (["plot", "OUT", "--out", "a.txt"], r"must end in \.png, \.pdf or \.svg"),
        (["plot", "OUT", "--out", "/nowhere/a.png"], "cannot be written"),
    ],
)
def test_what_cannot_be_shown(arguments, message, folder, tmp_path, monkeypatch, capsys):
    """Refused in one line, with exit code 2."""
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main([str(folder) if a == "OUT" else a for a in arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("run.json", "{"),
        ("run.json", "[]"),
        ("fields/fields.pvd", "<VTKFile>"),
        ("fields/fields.pvd", "<VTKFile/>"),
        ("fields/fields000004.vtu", "nothing"),
        ("history.csv", ""),
    ],
)
def test_damaged_results(name, damage, folder, tmp_path):
    """Refused by name."""
    shutil.copytree(folder, tmp_path / "out")
    (tmp_path / "out" / name).write_text(damage)
    with pytest.raises(ResultsError, match=re.escape(name)):
        results = load(tmp_path / "out")
        results.field("strain")
        results.summary()


def test_page_plays_in_a_browser(folder, tmp_path, monkeypatch):
    """A click on play moves the body on the screen."""
    pytest.importorskip("trame")
    rendering(folder)
    with chromium(tmp_path, monkeypatch) as browser:
        command = [sys.executable, "-m", "demos.viewing", str(folder), "--port", "0"]
        page = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            assert page.stdout is not None
            address = re.search(r"http://\S+", page.stdout.readline())
            assert address is not None
            browser.get(address[0])
            still = wait_for(lambda: browser.find_elements("css selector", "img[src^=blob]"))
            first = still[0].get_attribute("src")
            button = wait_for(lambda: browser.find_elements("id", "play"))
            button[0].click()
            shown = lambda: browser.find_elements("css selector", "img[src^=blob]")[0]  # noqa: E731
            wait_for(lambda: shown().get_attribute("src") != first)
            one = browser.get_screenshot_as_png()
            wait_for(lambda: browser.get_screenshot_as_png() != one)
        finally:
            page.send_signal(signal.SIGINT)
            page.communicate(timeout=20)


def wait_for(what, seconds: float = 30.0):
    """What `what` gives, once that is something."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := what():
            return found
        time.sleep(0.2)
    raise AssertionError("it does not appear")
