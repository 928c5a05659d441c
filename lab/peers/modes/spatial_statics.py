"""Statics of the 27 flexures in space and of a few moment modes replacing them: distance between the rest
positions of the burr and of the farthest link.

Usage: python spatial_statics.py [PROBLEM] (from the repository's root, with numpy; all problems whose name
contains PROBLEM)

The chain is that of the rung `spatial`: each flexure rotates by bending (about y), lateral bending (about x)
and torsion (about z) on springs; the standard tool's flexure positions and bending stiffnesses are read from
`crates/simulation/src/manipulator/parameters.rs`, the ratios of the other two are those of
docs/accuracy-physics.md at the first, the middle and the last flexure, linear between them. The mount is
rigid, tendons have no friction. A tunnel is round: its wall presses on the middle of each link, and on the
burr, with 1 N/um beyond the clearance.

Modes: moments that are polynomials along the tool, orthonormal under the compliance, separately for each kind
of bend. The energy is minimised by Newton's method, with the load or the wall applied in steps.
"""
import re
import sys
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre

SOURCE = Path("crates/simulation/src/manipulator/parameters.rs").read_text()
SETS = [(5, 1, 1), (5, 2, 2), (5, 3, 2), (5, 5, 5)]
WALL_N_PER_M = 1e6
STEPS = 8


def table(name):
    return np.array([
        float(x) for x in re.search(name + r"[^=]*=\s*\[([^\]]*)\]", SOURCE)[1].split(",") if x.strip()])


PLACE = table("JHU_JOINTS_MM") * 1e-3
BENDING = table("JHU_STIFFNESS_NM_PER_DEG") * 180.0 / np.pi
COUNT = len(PLACE)
NUMBER = np.arange(COUNT)
LATERAL = np.interp(NUMBER, [0, 13, 26], [0.66971 / 0.027943, 0.48321 / 0.015822, 0.37231 / 0.010293])
TORSION = np.interp(NUMBER, [0, 13, 26], [0.68736 / 0.027943, 0.63846 / 0.015822, 0.60230 / 0.010293])
STIFFNESS = np.stack([BENDING, BENDING * LATERAL, BENDING * TORSION], 1)
LENGTH = np.append(np.diff(PLACE), 4e-3)
ALONG = 2.0 * (PLACE - PLACE[0]) / (PLACE[-1] + 4e-3 - PLACE[0]) - 1.0
# Axis, and the two columns that turn about it, of each kind of bend.
TURNS = ((1, 2, 0), (0, 1, 2), (2, 0, 1))


class Tunnel:
    """A tunnel, straight for `straight` m, then an arc toward +x of radius `radius` m in a plane rotated
    about z by `turn` degrees.
    """

    def __init__(self, radius, straight, turn=0.0, clearance=0.35e-3):
        self.radius, self.straight, self.turn, self.clearance = radius, straight, np.radians(turn), clearance

    def off(self, points):
        """Returns the vectors from the centre line to the points."""
        x_axis = np.array([np.cos(self.turn), np.sin(self.turn), 0.0])
        y_axis = np.array([-x_axis[1], x_axis[0], 0.0])
        x, y, z = points @ x_axis, points @ y_axis, points[:, 2] - PLACE[0] - self.straight
        straight, r = (z <= 0.0) & (x < self.radius), np.hypot(x - self.radius, z)
        size = np.where(straight, x, self.radius - r)
        along_x = size * np.where(straight, 1.0, (self.radius - x) / r)
        along_z = size * np.where(straight, 0.0, -z / r)
        return along_x[:, None] * x_axis + along_z[:, None] * np.array([0.0, 0.0, 1.0]) + y[:, None] * y_axis


def pose(q):
    """Returns flexures, their rotation axes, middles of the links (for the last one the burr), and burr."""
    turn, place = np.eye(3), np.array([0.0, 0.0, PLACE[0]])
    origin, axis, middle = np.zeros((COUNT, 3)), np.zeros((COUNT, 3, 3)), np.zeros((COUNT, 3))
    for i in range(COUNT):
        origin[i] = place
        for kind, (about, a, b) in enumerate(TURNS):
            axis[i, kind] = turn[:, about]
            sin, cos = np.sin(q[i, kind]), np.cos(q[i, kind])
            u, v = turn[:, a].copy(), turn[:, b].copy()
            turn[:, a], turn[:, b] = u * cos + v * sin, v * cos - u * sin
        middle[i] = place + turn[:, 2] * LENGTH[i] * (0.5 if i + 1 < COUNT else 1.0)
        place = place + turn[:, 2] * LENGTH[i]
    return origin, axis, middle, place


def energy(q, tendons, force, tunnel, wider):
    """Returns the energy and its gradient. `tendons`: tension and channel (x, y) of each."""
    origin, axis, middle, burr = pose(q)
    gradient, total = STIFFNESS * q, 0.5 * np.sum(STIFFNESS * q * q) - force @ burr
    for tension, (x, y) in tendons:
        total -= 2.0 * tension * np.sum(x * np.sin(0.5 * q[:, 0]) - y * np.sin(0.5 * q[:, 1]))
        gradient[:, 0] -= tension * x * np.cos(0.5 * q[:, 0])
        gradient[:, 1] += tension * y * np.cos(0.5 * q[:, 1])
    loads = np.zeros((COUNT, 3))
    loads[-1] = force
    if tunnel:
        off = tunnel.off(middle)
        size = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
        deep = np.maximum(0.0, size - tunnel.clearance - wider)
        total += 0.5 * WALL_N_PER_M * np.sum(deep**2)
        loads -= (WALL_N_PER_M * deep / size)[:, None] * off
    behind = [np.cumsum(x[::-1], 0)[::-1] for x in (loads, np.cross(middle, loads))]
    moment = behind[1] - np.cross(origin, behind[0])
    return total, gradient - np.einsum("ikx,ix->ik", axis, moment)


def modes(counts):
    """Returns the angles per unit of each mode, by kind, orthonormal under the stiffness."""
    columns = []
    for kind, count in enumerate(counts):
        for degree in range(count):
            angles = np.zeros((COUNT, 3))
            angles[:, kind] = legendre.legval(ALONG, [0.0] * degree + [1.0]) / STIFFNESS[:, kind]
            columns.append(angles.ravel())
    basis = np.stack(columns, 1)
    return np.linalg.solve(np.linalg.cholesky(basis.T @ (STIFFNESS.ravel()[:, None] * basis)), basis.T).T


def rest(basis, tendons, force=(0.0, 0.0, 0.0), tunnel=None):
    """Returns the angles at rest."""
    c = np.zeros(basis.shape[1])
    for share in np.arange(1, STEPS + 1) / STEPS:
        part = [(share * tension, channel) for tension, channel in tendons]
        loads = (part, share * np.array(force), tunnel, (1.0 - share) * 10e-3)

        def at(c, loads=loads):
            total, gradient = energy((basis @ c).reshape(COUNT, 3), *loads)
            return total, basis.T @ gradient.ravel()

        total, gradient = at(c)
        for _ in range(200):
            if np.linalg.norm(gradient) < 1e-9:
                break
            units = 1e-7 * np.eye(len(c))
            matrix = np.stack([(at(c + unit)[1] - at(c - unit)[1]) / 2e-7 for unit in units], 1)
            values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
            way, length = -vectors @ (vectors.T @ gradient / np.maximum(np.abs(values), 1e-3)), 1.0
            while (length > 1e-6
                   and at(c + length * way)[0] > total + 1e-4 * length * (gradient @ way) + 1e-15):
                length *= 0.5
            if length <= 1e-6:
                break
            c = c + length * way
            total, gradient = at(c)
    return (basis @ c).reshape(COUNT, 3)


def pulled(toward, across=0.0):
    return [(toward, (2.5e-3, 0.0)), (across, (0.0, 2.5e-3))]


NONE = (0.0, 0.0, 0.0)
PROBLEMS = {
    "10 N": (pulled(10.0),),
    "3 N across": (pulled(0.0), (0.0, 3.0, 0.0)),
    "10 N, 1 N across": (pulled(10.0), (0.0, 1.0, 0.0)),
    "10 N, 5 N across": (pulled(10.0), (0.0, 5.0, 0.0)),
    "6 N, 20 N of a tendon across": (pulled(6.0, 20.0),),
    "R 20 mm, 12 N": (pulled(12.0), NONE, Tunnel(20e-3, 12e-3)),
    "R 20 mm, 4 N": (pulled(4.0), NONE, Tunnel(20e-3, 12e-3)),
    "R 40 mm, 12 N": (pulled(12.0), NONE, Tunnel(40e-3, 5e-3)),
    "R 20 mm, 12 N, 5 N across": (pulled(12.0), (0.0, 5.0, 0.0), Tunnel(20e-3, 12e-3)),
    "R 20 mm turned by 5 degrees, 12 N": (pulled(12.0), NONE, Tunnel(20e-3, 12e-3, 5.0)),
    "R 20 mm turned by 5 degrees, 4 N": (pulled(4.0), NONE, Tunnel(20e-3, 12e-3, 5.0)),
    "R 40 mm turned by 10 degrees, 12 N": (pulled(12.0), NONE, Tunnel(40e-3, 5e-3, 10.0)),
}

for name, problem in PROBLEMS.items():
    if len(sys.argv) > 1 and sys.argv[1] not in name:
        continue
    flexures = rest(np.diag(1.0 / np.sqrt(STIFFNESS.ravel())), *problem)
    origin, _, _, burr = pose(flexures)
    line = f"{name}: {1e3 * burr[1]:.2f} mm across; burr, farthest link, um:"
    for counts in SETS:
        other_origin, _, _, other_burr = pose(rest(modes(counts), *problem))
        farthest = np.max(np.linalg.norm(other_origin - origin, axis=1))
        line += f"  {counts}: {1e6 * np.linalg.norm(other_burr - burr):.1f}, {1e6 * farthest:.1f}"
    print(line, flush=True)
