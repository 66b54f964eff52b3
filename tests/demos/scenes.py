"""Texts of scenes for tests."""

from __future__ import annotations


def bar(
    time: str,
    *,
    cells: str = "[4, 2]",
    material: str = "stable-neo-hookean",
    nu: float = 0.3,
    g: float = -9.81,
) -> str:
    """A bar of 2 m × 1 m that is held at x = 0, under gravity.

    Args:
        time: What stands in [time], and after.
        cells: Of the box.
        material: Its name.
        nu: Poisson's ratio.
        g: Acceleration along y [m/s²].
    """
    return f"""\
[mesh]
box = {{ size = [2.0, 1.0], cells = {cells} }}
[[material]]
name = "{material}"
E = 1e5
nu = {nu}
rho = 1000.0
[[boundary]]
where = {{ x = "min" }}
motion = "fixed"
[load]
gravity = [0.0, {g}]
[time]
{time}"""
