"""`mixed-fem compare`: UFL and the hand-derived system agree, and a small error does not pass."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from demos.app.cli import main
from demos.by_hand import ERRATA, MATERIALS, Corotational, SeedSystem, SymmetricSystem
from demos.by_hand.compare import report
from demos.by_hand.compare.bodies import BODIES, FEASIBLE, STATES
from demos.by_hand.compare.cases import SYSTEMS
from demos.by_hand.compare.equations import items
from demos.by_hand.compare.item import CONDENSED
from demos.by_hand.compare.verdicts import compare, missing, table
from tests.by_hand.ufl import COMM, all_cases, failed, some

SYSTEM = {"seed": SeedSystem, "symmetric": SymmetricSystem}
# Identically zero in the symmetric formulation, so that there is nothing to scale.
ZERO = {("symmetric", "F"), ("symmetric", "C")}


def test_every_equation_agrees_in_every_case():
    """Every number has a row or a reason, and every case takes part in every row it can."""
    comparisons = compare(all_cases())
    rows = table(comparisons)
    assert [row for row in rows if not row.agrees] == []
    assert missing(rows) == []
    silent = {e.number for e in ERRATA} - {row.equation for row in rows}
    assert silent == {e.number for e in ERRATA if e.verdict == "not comparable"} == {1, 25}
    assert {c.case for c in comparisons} == {
        (body, formulation, material, state)
        for body in BODIES
        for formulation in SYSTEMS
        for material in MATERIALS
        for state in STATES
    }
    steps = [row for row in rows if "step" in row.what]
    assert {row.equation for row in steps} == {35, 41, CONDENSED}
    assert all(row.worst.tolerance == 1e-10 for row in rows if row not in steps)
    assert {row.worst.tolerance for row in steps if "as printed" not in row.what} == {1e-9}
    assert {row.worst.tolerance for row in steps if "as printed" in row.what} == {1e-7}


@pytest.mark.serial
def test_states_are_what_they_are_called():
    """S = S(F) within round-off or violated by far; cells turned over or not; nothing special."""
    for case in all_cases():
        kind, step = case.names[3], case.step
        c = np.linalg.norm(case.constraint.first["l"])
        size = np.linalg.norm(case.constraint.second["ls"] @ case.unknowns["s"])
        if kind in FEASIBLE:
            assert c < 1e-14 * size
        else:
            assert c > 0.05 * size
        moves = kind != "rest"
        assert (np.linalg.norm(case.unknowns["x"] - step.iterate.X.ravel()) > 0.5) == moves
        assert np.any(case.unknowns["l"]) == np.any(step.velocity) == moves
        F = SeedSystem(step.iterate, None).deformation_gradient
        sigma = np.linalg.svd(F, compute_uv=False)
        inverted = np.linalg.det(F) < 0
        assert np.any(inverted) == (kind == "inverted")
        if kind == "inverted":
            assert np.max(sigma[:, 0] / sigma[:, -1]) > 199
            assert len(F) == 1 or not np.all(inverted)
            assert (step.nu, step.h) == (0.4999, 0.013)
        if kind not in FEASIBLE and case.names[1] == "seed":
            Lam = step.iterate.Lam
            skew = np.linalg.norm(Lam - np.swapaxes(Lam, 1, 2), axis=(1, 2))
            assert np.all(skew > 0.01 * np.linalg.norm(Lam, axis=(1, 2)))
        assert np.all(np.abs(step.rho - 2.0) > 1e-3)
        assert np.all(step.f_ext.mean(axis=0) != 0.0)
        assert np.all(np.ptp(step.f_ext, axis=0) > 0.5)
    assert {len(case.step.iterate.cells) for case in all_cases()} == {1, 12, 8}


def changed(block):
    """A block with relative errors of 1e-6, different in every entry."""
    if sp.issparse(block):
        block = sp.csr_array(block, copy=True)
        block.data = changed(block.data)
        return block
    noise = np.random.default_rng(0).choice([-1.0, 1.0], np.shape(block))
    return block * (1.0 + 1e-6 * noise)


@pytest.mark.serial  # as the next two: plain NumPy, with the same arrays on all ranks
@pytest.mark.parametrize("formulation", SYSTEMS)
def test_an_error_of_1e_6_in_any_block_is_found(formulation):
    """In each block that the witness has, alone."""
    cases = some(formulation, states=("infeasible",))  # where nothing vanishes by itself
    names = SYSTEM[formulation].block_names()
    changes, missed = set(), []

    def wrong(system, block):
        value = getattr(system, block)
        if (formulation, block) in ZERO:
            assert value.nnz == 0
            new = 1e-6 * sp.eye_array(*value.shape, format="csr")
        elif not np.any(value.data if sp.issparse(value) else value):
            return system  # of the term with ε, in the printed system
        else:
            new = changed(value)
        changes.add(block)
        return system.with_blocks(**{block: new})

    assert failed(cases) == []
    for block in names:
        if not failed(cases, lambda system, block=block: wrong(system, block)):
            missed.append(block)
    assert missed == []
    assert changes == set(names)


@pytest.mark.serial
def test_an_error_in_one_case_alone_is_found():
    """One entry of one material."""
    cases = [case for case in all_cases() if case.names[0] == BODIES[1]]

    def hook(system):
        if not isinstance(system.material, Corotational):
            return system
        g = system.g_K.copy()
        g[5, 0] *= 1.0 + 1e-6
        return system.with_blocks(g_K=g)

    bad = failed(cases, hook)
    assert {row.equation for row in bad} >= {2, 10, 11, 35, 41}
    assert {row.worst.case[2] for row in bad} == {"corotational"}


@pytest.mark.serial
def test_what_is_not_a_number_differs():
    cases = some("seed", BODIES[0])
    rows = failed(cases, lambda system: system.with_blocks(g_x=np.nan * system.g_x))
    assert {9, 28, 35} <= {row.equation for row in rows}
    broken = [replace(case, moved=np.nan) for case in cases]
    assert [row.equation for row in failed(broken)] == [5]


@pytest.mark.serial
def test_finite_differences_confirm_ufls_W_hat_and_second_derivative():
    """(17) and (24) as UFL has them, by differences of W and E_Λ, which know no derivative."""
    (case,) = some("seed", states=("infeasible",))
    found = {(item.equation, item.what): item.expected for item in items(case)}
    W_hat, E_xx = found[17, "Ŵ_K, times J_K"], found[24, "∂²E_Λ/∂x²"]
    system = SeedSystem(case.step.iterate, None)
    s, direction = system.s, np.random.default_rng(5).standard_normal(case.unknowns["x"].size)

    def at(step):
        x = (case.unknowns["x"] + step * direction).reshape(-1, 3)
        return SeedSystem(replace(case.step.iterate, x=x), None)

    h = 1e-5
    difference = (at(h).W - at(-h).W) / (2 * h) * system.volume[:, None, None]
    for k in range(s.shape[1]):
        np.testing.assert_allclose(
            W_hat[k] @ direction, difference[..., k].ravel(), rtol=0, atol=1e-8
        )
    h = 1e-3
    stencil = (-1, 16, -30, 16, -1)
    values = [at(k * h).E_Lambda() for k in range(-2, 3)]
    second = sum(w * v for w, v in zip(stencil, values, strict=True)) / (12 * h**2)
    assert direction @ E_xx @ direction == pytest.approx(second, rel=1e-6)


def said(capfd):
    """What rank 0 printed on stdout, on every rank; the others must have been silent."""
    out = capfd.readouterr().out
    assert COMM.rank == 0 or out == ""
    return COMM.bcast(out)


@pytest.fixture
def known(monkeypatch):
    """UFL's side is not assembled a second time, and one body is enough."""
    cases = [case for case in all_cases() if case.names[0] == BODIES[0]]
    monkeypatch.setattr(report, "ufl_cases", lambda comm, screen: cases)
    return cases


def test_table(known, capfd):
    assert main(["compare"]) == 0
    lines = said(capfd).splitlines()
    for erratum in ERRATA:
        assert sum(line.lstrip().startswith(f"({erratum.number})") for line in lines) == 1
    assert sum("not comparable:" in line for line in lines) == 2
    assert "0 rows differ" in lines[-1]


@pytest.mark.serial
def test_one_equation(known, capfd):
    """As in the seed, as it should be, what is compared and the numbers; the others not."""
    assert main(["compare", "--equation", "23"]) == 0
    text = said(capfd)
    erratum = ERRATA[22]
    assert text.index(erratum.printed) < text.index(erratum.corrected) < text.index("compared")
    rows = [line for line in text.splitlines() if line.endswith("agrees")]
    assert [line.split("  ")[1] for line in rows] == ["∂²E_Λ/∂x∂s", "its text, corrected"]
    assert all(len(re.findall(r"\d\.\de[+-]\d\d", line)) == len(STATES) for line in rows)
    assert main(["compare", "--equation", "23", "--json"]) == 0
    document = json.loads(said(capfd))
    assert [e["equation"] for e in document["equations"]] == [23]
    assert {row["equation"] for row in document["rows"] + document["comparisons"]} == {23}


def test_one_equation_with_nothing_to_compare_compiles_nothing(monkeypatch, capfd):
    monkeypatch.setattr(report, "ufl_cases", None)
    for number in ("1", "25"):
        assert main(["compare", "--equation", number]) == 0
        assert "not comparable" in said(capfd)


@pytest.mark.parametrize("number", ["0", "42"])
def test_an_equation_that_is_not_there_is_bad_input(number, capfd):
    assert main(["compare", "--equation", number]) == 2
    error = COMM.bcast(capfd.readouterr().err)
    assert error == f"mixed-fem: equation {number}: the seed numbers its equations 1 to 41\n"


@pytest.mark.serial
def test_json_is_the_last_thing_on_stdout(known, capfd):
    assert main(["compare", "--json"]) == 0
    document = json.loads(said(capfd))
    assert document["passed"] is True
    assert document["ranks"] == COMM.size
    assert [e["equation"] for e in document["equations"]] == list(range(1, 42))
    assert all(e["compared"] or e["reason"] for e in document["equations"])
    assert {row["verdict"] for row in document["rows"]} == {"agrees"}
    assert len(document["comparisons"]) > 1000


def test_exit_code_1_on_all_ranks_if_something_differs(known, monkeypatch, capfd):
    wrong = [replace(case, moved=(1.0 + 1e-9) * case.moved) for case in known]
    monkeypatch.setattr(report, "ufl_cases", lambda comm, screen: wrong)
    for as_json in (False, True):
        assert report.run(COMM, as_json) == 1
        out = said(capfd)
        assert "DIFFERS" in out
    document = json.loads(out)
    assert document["passed"] is False
    different = [row for row in document["rows"] if row["verdict"] != "agrees"]
    assert [(row["equation"], row["size"]) for row in different] == [(5, [1])]
