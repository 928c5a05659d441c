"""Statics of tools with helical tendons, by SciPy. `-s` shows a table of the differences.

The equations are those of Rucker and Webster 2011 ("Statics and dynamics of continuum robots with general
tendon routing and external loading", IEEE Trans. Robotics 27(6):1033, doi 10.1109/TRO.2011.2160469), section
IV, for a rod that neither shears nor stretches: a tendon at r(s) in the rod's axes, with the tension T, runs
along `p' = u x r + r' + e_z`, pulls the rod with the force `T d/ds (p'/|p'|)` per length and the moment of
that force about the rod's axis, and at its end with `-T p'/|p'|`. They are integrated as an initial-value
problem whose curvature at the base is shot at the end's moment. The rod is that of the tool: E I and G J = E
I / (1 + nu), straight at rest.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import support
import trabecula
from trabecula.sim import Sim

integrate, optimize, transform = support.needs("scipy.integrate", "scipy.optimize", "scipy.spatial.transform")
Rotation = transform.Rotation

Array = npt.NDArray[np.float64]

#: The rod: the flexible part, 40 mm in front of a rigid shaft of 40 mm, with the burr's centre at its end.
SHAFT_M, LENGTH_M, RADIUS_M = 0.040, 0.040, 2.0e-3
OUTER_M, INNER_M, MODULUS_PA, POISSON = 1.5e-3, 1.25e-3, 0.3e9, 0.33
BENDING_NM2 = MODULUS_PA * np.pi / 4 * (OUTER_M**4 - INNER_M**4)
STIFFNESS_NM2: Array = np.array([BENDING_NM2, BENDING_NM2, BENDING_NM2 / (1 + POISSON)])

#: Twist, degrees per millimetre; start angles of the tendons, degrees; their tensions, N.
CASES: list[tuple[float, list[float], list[float]]] = [
    (4.5, [0.0], [5.0]),
    (9.0, [0.0], [8.0]),
    (-9.0, [90.0], [8.0]),
    (6.0, [0.0, 120.0], [6.0, 3.0]),
]
LINKS = (8, 16, 32)


def cross(a: Array) -> Array:
    """Returns the cross-product matrix of a; `numpy.cross` takes ten times as long."""
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class Tendon:
    """Returns its position in the rod's axes and the position's two derivatives, at an arc length."""

    def __init__(self, twist_deg_per_mm: float, start_deg: float, tension_n: float) -> None:
        self.declared = (twist_deg_per_mm, start_deg)
        self.rate = np.radians(twist_deg_per_mm) * 1e3
        self.start = np.radians(start_deg)
        self.tension_n = tension_n

    def at(self, share: float) -> Tendon:
        """Returns the same tendon with a fraction of its tension."""
        return Tendon(*self.declared, share * self.tension_n)

    def place(self, s: float) -> tuple[Array, Array, Array]:
        angle = self.start + self.rate * s
        radial, around = (
            np.array([np.cos(angle), np.sin(angle), 0.0]),
            np.array([-np.sin(angle), np.cos(angle), 0.0]),
        )
        return RADIUS_M * radial, RADIUS_M * self.rate * around, -RADIUS_M * self.rate**2 * radial


E_Z: Array = np.array([0.0, 0.0, 1.0])


def bent(u: Array, s: float, tendons: list[Tendon]) -> Array:
    """u' from the balance of moments and forces of rod and tendons.

    Let n be the rod's inner force. Without load on the rod but the tendons', n + sum T p'/|p'| = 0 all along,
    since the end carries no more. So n follows from u, and the moments' balance (K u)' + u x K u + e_z x n +
    sum r x T (p'/|p'|)' = 0, in the rod's axes, gives u': the direction's derivative contains u x r.
    """
    matrix, right = np.diag(STIFFNESS_NM2), -(cross(u) @ (STIFFNESS_NM2 * u))
    for tendon in tendons:
        r, r1, r2 = tendon.place(s)
        along = cross(u) @ r + r1 + E_Z
        size = np.linalg.norm(along)
        # A = -T [p']^2 / |p'|^3 is the matrix of T d(p'/|p'|), as in the paper's (13) to (17).
        a = -tendon.tension_n * cross(along) @ cross(along) / size**3
        # (p')' in the rod's axes: u x p' + u' x r + u x r' + r''.
        matrix = matrix + cross(r) @ a @ -cross(r)
        right = (
            right
            - cross(r) @ a @ (cross(u) @ (along + r1) + r2)
            + cross(E_Z) @ (tendon.tension_n * along / size)
        )
    return np.asarray(np.linalg.solve(matrix, right))


def shape(base_u: Array, tendons: list[Tendon]) -> Any:
    """Returns position, attitude as a matrix and curvature along the rod, starting at its base."""

    def rate(s: float, y: Array) -> Array:
        turn, u = y[3:12].reshape(3, 3), y[12:]
        return np.concatenate([turn[:, 2], (turn @ cross(u)).ravel(), bent(u, s, tendons)])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), base_u])
    return integrate.solve_ivp(rate, (0.0, LENGTH_M), start, method="DOP853", rtol=1e-9, atol=1e-11)


def end_moment(base_u: Array, tendons: list[Tendon]) -> Array:
    """Returns the residual of the rod's end moment against the tendons', divided by E I: K u + sum r x T
    p'/|p'| = 0 there.
    """
    u = shape(base_u, tendons).y[12:, -1]
    moment = STIFFNESS_NM2 * u
    for tendon in tendons:
        r, r1, _ = tendon.place(LENGTH_M)
        along = cross(u) @ r + r1 + E_Z
        moment = moment + cross(r) @ (tendon.tension_n * along / np.linalg.norm(along))
    return np.asarray(moment / BENDING_NM2)


def solved(tendons: list[Tendon]) -> Any:
    guess = np.zeros(3)
    # Applying the full load at once can make the solver diverge.
    for share in np.linspace(0.2, 1.0, 5):
        part = [tendon.at(share) for tendon in tendons]
        found = optimize.root(end_moment, guess, args=(part,), options={"eps": 1e-6, "xtol": 1e-9})
        assert np.abs(found.fun).max() < 1e-6, f"{found.message}: {found.fun}"
        guess = found.x
    return shape(guess, tendons)


def scene(links: int, twist: float, starts: list[float], folder: Path) -> Path:
    pitch_mm = LENGTH_M * 1e3 / links
    text = f"""
name = "helical"
run = {{ mode = "lockstep", duration_s = 60.0 }}
gravity_m_per_s2 = [0.0, 0.0, 0.0]
[tool]
burr_start_mm = [0.0, 0.0, {(SHAFT_M + LENGTH_M) * 1e3!r}]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "puller"
drives = ["tendon", "arm", "burr"]
external = true
[manipulator]
model = "spatial"
[manipulator.tool]
name = "helical"
damping_ratio = 1.0
mount_stiffness_n_per_m = 1e7
[manipulator.tool.tube]
outer_diameter_mm = {2e3 * OUTER_M!r}
inner_diameter_mm = {2e3 * INNER_M!r}
linear_density_kg_per_m = 0.02
youngs_modulus_gpa = {MODULUS_PA * 1e-9!r}
poisson_ratio = {POISSON!r}
[manipulator.tool.stop]
angle_deg = 90.0
[manipulator.tool.burr]
diameter_mm = 3.0
offset_mm = {pitch_mm / 2!r}
mass_g = 0.1
[[manipulator.tool.flexure]]
at_mm = {SHAFT_M * 1e3 + pitch_mm / 2!r}
count = {links}
pitch_mm = {pitch_mm!r}
"""
    for start in starts:
        x, y = RADIUS_M * 1e3 * np.cos(np.radians(start)), RADIUS_M * 1e3 * np.sin(np.radians(start))
        place = f"toward_mm = {float(x)!r}\nacross_mm = {float(y)!r}\n"
        text += f"[[manipulator.tool.tendon]]\n{place}twist_deg_per_mm = {twist!r}\n"
    file = folder / f"helical_{links}.toml"
    file.write_text(text)
    return file


def settled(file: Path, tensions_n: list[float]) -> tuple[Array, Any]:
    """Returns position and attitude of the burr, relative to the start of the flexible part."""
    sim = Sim(file)
    made = trabecula.Command()
    made.tendon_mode = trabecula.TendonMode.SERVO_JF
    for index, tension_n in enumerate(tensions_n):
        made.tendon_force_n[index] = tension_n
    state = sim.state
    for _ in range(1500):
        state = sim.step(made)
    raw = state.array
    base = Rotation.from_quat(raw["t_world_base"]["orientation_xyzw"])
    from_base = base.inv().apply(raw["t_world_burr"]["position_m"] - raw["t_world_base"]["position_m"])
    return from_base - [0.0, 0.0, SHAFT_M], base.inv() * Rotation.from_quat(
        raw["t_world_burr"]["orientation_xyzw"]
    )


@pytest.mark.parametrize(("twist", "starts", "tensions_n"), CASES)
def test_the_tool_bends_as_rucker_and_websters_equations(
    twist: float, starts: list[float], tensions_n: list[float], tmp_path: Path
) -> None:
    tendons = [Tendon(twist, start, tension) for start, tension in zip(starts, tensions_n)]
    exact = solved(tendons)
    place, turn = exact.y[:3, -1], Rotation.from_matrix(exact.y[3:12, -1].reshape(3, 3))
    found = [settled(scene(links, twist, starts, tmp_path), tensions_n) for links in LINKS]
    off_m = [float(np.linalg.norm(at - place)) for at, _ in found]
    turned = float((found[-1][1].inv() * turn).magnitude())
    moved_m = float(np.linalg.norm(place - [0.0, 0.0, LENGTH_M]))
    # First order, since a flexure turns about its axes one after the other, and second, as chords are to an
    # arc: three numbers of flexures, each twice the one before, extrapolate to no error of either.
    limit_m = float(np.linalg.norm((found[0][0] - 6 * found[1][0] + 8 * found[2][0]) / 3 - place))
    print(
        f"twist {twist} degrees/mm, {'+'.join(map(str, tensions_n))} N: moved {1e3 * moved_m:.2f} mm; off at"
        f" {', '.join(map(str, LINKS))} flexures {', '.join(f'{1e6 * off:.0f}' for off in off_m)} um;"
        f" extrapolated {1e6 * limit_m:.1f} um; turned {1e3 * turned:.2f} mrad"
    )
    assert moved_m > 5e-3, "a load that shows"
    assert off_m[2] < 0.01 * moved_m, f"{off_m[2]} m off at {LINKS[2]} flexures"
    assert off_m[2] < off_m[1] / 1.8 < off_m[0] / 3.24, f"{off_m}: it does not converge"
    assert limit_m < 0.002 * moved_m, f"{limit_m} m off when extrapolated"
    assert turned < 0.01, f"{turned} rad off at {LINKS[2]} flexures"
    # The same rod with the opposite twist has a different shape.
    other = solved([Tendon(-twist, start, tension) for start, tension in zip(starts, tensions_n)]).y[:3, -1]
    assert float(np.linalg.norm(other - place)) > 20 * off_m[2], "the twist's sense does not show"
