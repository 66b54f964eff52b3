"""Errors of the kind that mild states let through change the verdict of `compare`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from demos.app.cli import main
from demos.app.progress import Screen
from demos.by_hand import lame_parameters
from demos.by_hand import rotation as by_hand
from demos.by_hand.compare import report, texts
from demos.by_hand.compare.bodies import BODIES, STATES
from demos.by_hand.compare.cases import ufl_cases
from demos.by_hand.compare.verdicts import compare
from demos.by_hand.errata import ERRATA
from forms.materials import base
from tests.by_hand.ufl import COMM, all_cases, failed

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks

MATERIAL = "stable-neo-hookean"


@pytest.fixture(scope="module")
def cases():
    """The single tetrahedron and the triangles, one material, at every state; all agrees."""
    found = [
        case
        for case in all_cases()
        if case.names[0] in (BODIES[0], BODIES[2]) and case.names[2] == MATERIAL
    ]
    assert failed(found) == []
    return found


def unsigned_svd(F):
    U, sigma, Vt = np.linalg.svd(F)
    return U, sigma, np.swapaxes(Vt, -1, -2)


def svd_without_signs_of_sigma(F):
    U, sigma, V = signed_svd(F)
    return U, np.abs(sigma), V


signed_svd = by_hand.signed_svd


@pytest.mark.parametrize("svd", [unsigned_svd, svd_without_signs_of_sigma])
def test_signs_of_the_singular_values(cases, monkeypatch, svd):
    """Inverted cells alone can tell."""
    monkeypatch.setattr(by_hand, "signed_svd", svd)
    bad = [c for c in compare(cases) if not c.agrees]
    assert {14, 15, 17, 24, 35, 41} <= {c.equation for c in bad}
    assert {c.case[3] for c in bad} == {"inverted"}


HOOKS = {
    "ρ → ρ²/2": lambda w: replace(w, rho=w.rho**2 / 2),
    "ρ the same in every cell": lambda w: replace(w, rho=float(np.mean(w.rho))),
    "f's x-component dropped": lambda w: replace(w, f_ext=w.f_ext * (np.arange(w.d) > 0)),
    "f averaged over the vertices": lambda w: replace(w, f_ext=w.f_ext.mean(axis=0)),
    "v dropped": lambda w: replace(w, v=0.0),
    "h → h²/0.4": lambda w: replace(w, h=w.h**2 / 0.4),
    "ε ignored": lambda w: replace(w, eps=one_over_mu(w)) if getattr(w, "eps", 0.0) else w,
    "Λ made symmetric": lambda w: replace(w, state=with_symmetric_multiplier(w.state)),
    "λ doubled": lambda w: replace(w, material=replace(w.material, lam=2 * w.material.lam)),
}


def one_over_mu(w):
    return 1.0 / w.material.mu


def with_symmetric_multiplier(state):
    return replace(state, Lam=0.5 * (state.Lam + np.swapaxes(state.Lam, 1, 2)))


@pytest.mark.parametrize("name", HOOKS)
def test_an_error_of_the_witness_changes_the_verdict(cases, name):
    assert failed(cases, HOOKS[name]) != []


def test_the_command_fails_with_an_error_in_the_witness(cases, monkeypatch, capfd):
    """Exit code 1 in place of 0."""
    monkeypatch.setattr(report, "ufl_cases", lambda comm, screen: cases)
    assert main(["compare", "--equation", "14"]) == 0
    assert "DIFFERS" not in capfd.readouterr().out
    monkeypatch.setattr(by_hand, "signed_svd", unsigned_svd)
    assert main(["compare", "--equation", "14"]) == 1
    assert "DIFFERS" in capfd.readouterr().out
    assert main(["compare"]) == 1


def test_lame_parameters_of_the_package(monkeypatch):
    """Its λ doubled: the witness finds its own from E and ν."""
    right = base.lame_parameters

    def wrong(E, nu):
        mu, lam = right(E, nu)
        return mu, 2.0 * lam

    monkeypatch.setattr(base, "lame_parameters", wrong)
    bad = failed(ufl_cases(COMM, Screen(COMM), BODIES[:1]))
    assert {10, 11, 30, 35, 41} <= {row.equation for row in bad}


def test_lame_parameters_are_those_of_uniaxial_stress():
    """By their meaning: σ = E ε along the axis and contraction ν ε across it."""
    for E, nu in ((10.0, setting.nu) for setting in STATES.values()):
        mu, lam = lame_parameters(E, nu)
        strain = np.diag([1.0, -nu, -nu])
        stress = 2 * mu * strain + lam * np.trace(strain) * np.eye(3)
        np.testing.assert_allclose(stress, np.diag([E, 0.0, 0.0]), atol=1e-10 * lam)


@pytest.mark.parametrize(
    ("number", "right", "wrong"),
    [
        (23, "J_ji^K Ŵ_jkl^K λ_k^K", "J_ji^K Ŵ_kjl^K λ_k^K"),
        (23, "= J_ji", "= -J_ji"),
        (24, "- L_aij Ω_akl", "+ L_aij Ω_akl"),
        (24, "E_aij E_bik M_kj", "E_aij E_bik M_jk"),
        (24, "R_ki Λ_kl", "R_ik Λ_kl"),
        (28, "- I) λ_K) V_K", "+ I) λ_K) V_K"),
        (35, "r_ε - g_x^t", "-g_x^t - r_ε"),
    ],
)
def test_a_wrong_sign_or_index_in_the_text(cases, monkeypatch, number, right, wrong):
    """Whatever the code does: it is the text that is evaluated."""
    true = ERRATA[number - 1].true
    assert true.count(right) == 1
    changed = replace(ERRATA[number - 1], corrected=true.replace(right, wrong))
    monkeypatch.setattr(texts, "ERRATA", (*ERRATA[: number - 1], changed, *ERRATA[number:]))
    bad = failed(cases)
    assert [row.equation for row in bad] == [number]
    assert "text" in bad[0].what
