"""What a run leaves on disk and in its table."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from mpi4py import MPI

import meshio
import numpy as np
import pytest
from dolfinx import fem

from demos.app.cli import main
from demos.app.fields import as_mesh
from demos.app.output import final_state
from demos.app.scene import Scene, parse
from demos.app.simulation import Simulation, build_body
from forms import MATERIALS, deformation_gradient
from tests.bodies import LOCAL
from tests.demos.strip import POINTS, STRIP, TRIANGLES, scene, table

COMM = MPI.COMM_WORLD


def last_fields(folder: Path) -> tuple[float, float]:
    """The largest |S - I| and |u| in the last of the files for ParaView."""
    mesh = meshio.read(sorted((folder / "fields").glob("fields*.vtu"))[-1])
    moved = np.linalg.norm(mesh.point_data["u"], axis=1)
    return mesh.cell_data["|S - I|"][0].max(), moved.max()


@pytest.mark.parametrize("formulation", LOCAL)
def test_final_state_is_in_file_order_and_consistent(formulation, strip):
    """X and cells as in the file; S, Λ and v follow from the positions, by other means."""
    given = dataclasses.replace(scene(strip), formulation=formulation)
    simulation = Simulation(given, build_body(given, COMM))
    state = final_state(simulation)
    for _ in simulation.march(given.steps):
        before, state = state, final_state(simulation)
        if COMM.rank == 0:
            velocity = (state["x"] - before["x"]) / given.h
            np.testing.assert_allclose(state["v"], velocity, rtol=0, atol=1e-12)
    if COMM.rank != 0:
        assert state is None
        return
    np.testing.assert_array_equal(state["X"], POINTS)
    np.testing.assert_array_equal(state["cells"], np.sort(TRIANGLES))
    assert state["t"] == pytest.approx(3 * given.h)
    assert np.abs(state["x"] - POINTS).max() > 0.05  # it has moved

    rest, now = (p[TRIANGLES[:, 1:]] - p[TRIANGLES[:, :1]] for p in (state["X"], state["x"]))
    F = np.linalg.solve(rest, now).transpose(0, 2, 1)
    U, sigma, Vt = np.linalg.svd(F)
    S = np.einsum("nji,nj,njk->nik", Vt, sigma, Vt)
    np.testing.assert_allclose(state["S"], S, rtol=0, atol=1e-9)
    material = MATERIALS["stable-neo-hookean"](1e5, 0.4)
    J = sigma.prod(axis=1)
    principal = (material.lam * (J - 1) - material.mu)[:, None] * J[
        :, None
    ] / sigma + material.mu * sigma
    P = np.einsum("nij,nj,njk->nik", U, principal, Vt)
    np.testing.assert_allclose(state["Lam"], P, rtol=0, atol=1e-9 * material.mu)


@pytest.mark.mpi
def test_final_state_does_not_depend_on_the_number_of_ranks(strip):
    given = scene(strip)
    states = []
    for comm in (COMM, MPI.COMM_SELF):
        simulation = Simulation(given, build_body(given, comm))
        list(simulation.march(given.steps))
        states.append(final_state(simulation))
        energies = simulation.energies()
        states[-1] = COMM.bcast(states[-1])
        states[-1]["energies"] = np.array([energies.kinetic, energies.elastic, energies.potential])
    many, one = states
    for key, values in one.items():
        scale = max(np.abs(values).max(), 1e-300)
        np.testing.assert_allclose(many[key] / scale, values / scale, atol=1e-12, err_msg=key)


# Other elements

BOX = STRIP.replace(
    'file = "strip.mesh"', 'box = { size = [2.0, 1.0], cells = [4, 2], cell = "quadrilateral" }'
)


def elements(cell: str, degree: int) -> Scene:
    """The strip as a box of other elements; in 3D of one metre, and two cells, across."""
    text = BOX.replace("quadrilateral", cell) + f"degree = {degree}\n"
    if cell == "hexahedron":
        text = text.replace("1.0], cells = [4, 2]", "1.0, 1.0], cells = [2, 1, 2]")
        text = text.replace("-9.81]", "-9.81, 0.0]")
    return parse(text, Path("box.toml"))


@pytest.mark.parametrize(
    ("cell", "degree"), [("quadrilateral", 1), ("quadrilateral", 2), ("hexahedron", 1)]
)
def test_final_state_of_other_elements(cell, degree):
    """Positions of vertices are dofs; S is the mean over Gauss's points, found by other means."""
    given = elements(cell, degree)
    simulation = Simulation(given, build_body(given, COMM))
    list(simulation.march(given.steps))
    state, body, u = final_state(simulation), simulation.body, simulation.fields[0]
    d, V = len(u), u.function_space
    owned = V.dofmap.index_map.size_local
    X = np.concatenate(COMM.allgather(V.tabulate_dof_coordinates()[:owned, :d]))
    x = X + np.concatenate(COMM.allgather(u.x.array.reshape(-1, d)[:owned]))
    nodes, weights = np.polynomial.legendre.leggauss(degree + 1)
    points = np.stack(np.meshgrid(*[(1 + nodes) / 2] * d, indexing="ij"), axis=-1).reshape(-1, d)
    weight = np.prod(np.meshgrid(*[weights / 2] * d, indexing="ij"), axis=0).ravel()
    cells = np.arange(len(body.file_cells), dtype=np.int32)
    F = fem.Expression(deformation_gradient(u), points).eval(body.mesh, cells)
    _, sigma, Vt = np.linalg.svd(F)
    S = np.einsum("q,kqji,kqj,kqjl->kil", weight, Vt, sigma, Vt)
    S = body.gather(S)
    if COMM.rank != 0:
        return
    for rest, now in zip(state["X"], state["x"], strict=True):
        (dof,) = np.flatnonzero(np.abs(X - rest).max(axis=1) < 1e-9)
        np.testing.assert_allclose(now, x[dof], rtol=0, atol=1e-12)
    assert np.abs(state["x"] - state["X"]).max() > 0.05
    np.testing.assert_allclose(state["S"], S, rtol=0, atol=1e-9)


# DOLFINx counts quadrilaterals up in y first, so that they are wound the other way.
@pytest.mark.parametrize(("cell", "volume"), [("quadrilateral", -0.25), ("hexahedron", 0.5)])
def test_surfaces_list_vertices_in_the_order_of_vtk(cell, volume, tmp_path):
    """Around the faces of a cell, all of the same sense."""
    given = elements(cell, 1)
    state = final_state(Simulation(given, build_body(given, COMM)))
    if state is None:
        return
    as_mesh(state).write(tmp_path / "body.vtu")
    (block,) = meshio.read(tmp_path / "body.vtu").cells
    corners = state["X"][block.data]
    to = corners - corners[:, :1]
    edges = to[:, [1, 3]] if cell == "quadrilateral" else to[:, [1, 3, 4]]
    np.testing.assert_allclose(np.linalg.det(edges), volume, rtol=1e-12)
    np.testing.assert_allclose(to[:, 2], to[:, 1] + to[:, 3], rtol=0, atol=1e-12)
    if cell == "hexahedron":
        np.testing.assert_allclose(to[:, 5:7], to[:, 1:3] + to[:, 4:5], rtol=0, atol=1e-12)


def test_run_with_quadratic_quadrilaterals(tmp_path):
    """Everything that a run writes; both formulations with one rule have the same positions."""
    path, out = tmp_path / "box.toml", tmp_path / "out"
    if COMM.rank == 0:
        path.write_text(BOX + "degree = 2\n")
    COMM.barrier()
    assert main(["run", str(path), "--out", str(out)]) == 0
    with np.load(out / "final.npz") as a, np.load(out / "displacement" / "final.npz") as b:
        assert a["cells"].shape == (8, 4)
        for name, scale in (("x", 1.0), ("S", 1.0), ("Lam", 1e5), ("von_mises", 1e5)):
            np.testing.assert_allclose(a[name], b[name], rtol=0, atol=1e-8 * scale)
        drawn, largest = last_fields(out)
        strain = np.linalg.norm(a["S"] - np.eye(2), axis=(1, 2))
        np.testing.assert_allclose(drawn, strain.max(), rtol=1e-10)
        moved = np.linalg.norm(a["x"] - a["X"], axis=1).max()
        np.testing.assert_allclose(largest, moved, rtol=1e-10)
    assert (out / "picture.png").exists() or (out / "picture.vtu").exists()


def test_materials_by_tag_are_those_of_their_cells(tmp_path):
    """Two tags of one material change nothing; a stiffer tip stretches less."""
    if COMM.rank == 0:
        tags = {"medit:ref": [np.where(POINTS[TRIANGLES, 0].mean(axis=1) < 1.5, 4, 7)]}
        meshio.Mesh(POINTS, [("triangle", TRIANGLES)], cell_data=tags).write(
            tmp_path / "strip.mesh"
        )
    COMM.barrier()
    material = STRIP[STRIP.index("[[material]]") : STRIP.index("[[boundary]]")]

    def final(*materials: str) -> np.ndarray:
        text = STRIP.replace(material, "".join(materials))
        given = parse(text, tmp_path / "strip.toml")
        simulation = Simulation(given, build_body(given, COMM))
        list(simulation.march(given.steps))
        return COMM.bcast((final_state(simulation) or {}).get("x"))

    one = final(material)
    two = final(material + "tag = 4\n", material + "tag = 7\n")
    np.testing.assert_allclose(two, one, rtol=0, atol=1e-12)
    root, tip = material + "tag = 4\n", material.replace("1e5", "1e7") + "tag = 7\n"
    stiff_tip = final(tip, root)
    assert np.abs(stiff_tip - POINTS).max() > 0.05
    stretches = [abs(np.linalg.norm(x[6] - x[7]) - 1) for x in (one, stiff_tip)]
    assert stretches[1] < 0.1 * stretches[0]
    # two strain energies in one body, that agree for small strains and not beyond
    hencky = material.replace("stable-neo-hookean", "hencky")
    smith = material.replace("stable-neo-hookean", "smith-neo-hookean")
    whole, half = final(smith), final(smith + "tag = 4\n", hencky + "tag = 7\n")
    assert 1e-6 < np.abs(half - whole).max() < 0.1 * np.abs(whole - POINTS).max()


def test_run_writes_what_it_says(strip, tmp_path, capfd):
    out = tmp_path / "out"
    assert main(["run", str(strip), "--out", str(out)]) == 0
    said = COMM.bcast(capfd.readouterr().out)
    for folder, fields in ((out, ["u", "S", "Y"]), (out / "displacement", ["u"])):
        history, newton = table(folder / "history.csv"), table(folder / "newton.csv")
        np.testing.assert_array_equal(history["step"], [1, 2, 3])
        np.testing.assert_allclose(history["time"], [0.05, 0.1, 0.15])
        # a row for the starting point and one for each iteration
        counts = [int((newton["step"] == k).sum()) for k in (1, 2, 3)]
        np.testing.assert_array_equal(counts, history["newton_iterations"] + 1)
        for name in fields:
            last = newton[f"residual_{name}"][np.cumsum(counts) - 1]
            np.testing.assert_array_equal(last, history[f"residual_{name}"])
        assert (history["residual_u"] < 1e-6 * newton["residual_u"][newton["iteration"] == 0]).all()
        # the rest state and three steps
        assert (folder / "fields" / "fields.pvd").read_text().count("<DataSet") == 4
    with np.load(out / "final.npz") as a, np.load(out / "displacement" / "final.npz") as b:
        assert {"X", "x", "v", "S", "Lam"} <= set(a)
        np.testing.assert_allclose(a["x"], b["x"], rtol=0, atol=1e-10)
        strain = np.linalg.norm(a["S"] - np.eye(2), axis=(1, 2))
        drawn, largest = last_fields(out)
        np.testing.assert_allclose(drawn, strain.max(), rtol=1e-10)
        moved = np.linalg.norm(a["x"] - a["X"], axis=1).max()
        np.testing.assert_allclose(largest, moved, rtol=1e-10)
        difference = np.abs(a["x"] - b["x"]).max()
    assert (out / "picture.png").exists() or (out / "picture.vtu").exists()
    # the table on the screen
    history = table(out / "history.csv")
    counts = " +".join(f"{count:.0f}" for count in history["newton_iterations"])
    total = history["newton_iterations"].sum()
    assert re.search(rf"^symmetric +{counts} +{total:.0f} ", said, re.M)
    assert re.search(rf"^displacement .* {difference:.1e}$", said, re.M)


def test_energies_balance(strip):
    """Backward Euler loses energy and never gains it; at first all of it is zero."""
    given = scene(strip)
    simulation = Simulation(given, build_body(given, COMM))
    totals = [sum(simulation.energies())]
    assert totals == [pytest.approx(0.0, abs=1e-12)]
    for _ in simulation.march(8):
        energies = simulation.energies()
        assert energies.kinetic > 0
        assert energies.elastic > 0
        totals.append(energies.kinetic + energies.elastic + energies.potential)
    assert (np.diff(totals) < 0).all()
