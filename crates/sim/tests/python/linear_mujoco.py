"""A chain of links on a mount in MuJoCo, by `mjd_transitionFD`.

Reads one JSON object with the tool and our M^-1 K, M^-1 D and M^-1 times the tendon's arm; prints the largest
difference of each, as a share of the largest entry of its row.
"""

import json
import math
import sys

import mujoco
import numpy as np

given = json.load(sys.stdin)
joints, stiffness = given["joints_m"], given["stiffness"]
outer, inner = given["radii_m"]
transverse = 0.25 * (outer**2 + inner**2)
lengths = [b - a for a, b in zip(joints, joints[1:])] + [given["tip_m"]]
burr_kg, burr_m = given["burr"]
shaft_kg, shaft_m = given["shaft"]


def link(index: int) -> tuple[float, float, float]:
    """Mass, centre and inertia across the axis; the last link carries the burr, a ball at its end."""
    length = lengths[index]
    mass = given["density"] * length
    centre, inertia = 0.5 * length, mass * (length**2 / 12.0 + transverse)
    if index + 1 < len(lengths):
        return mass, centre, inertia
    total = mass + burr_kg
    shared = (mass * centre + burr_kg * length) / total
    inertia += 0.4 * burr_kg * burr_m**2 + mass * (centre - shared) ** 2 + burr_kg * (length - shared) ** 2
    return total, shared, inertia


links = [link(index) for index in range(len(lengths))]
total_kg = shaft_kg + sum(mass for mass, _, _ in links)
mount_n_s_per_m = 2.0 * given["mount_ratio"] * math.sqrt(given["mount"] * total_kg)
slides = "".join(
    f'<joint type="slide" axis="{axis}" stiffness="{given["mount"]!r}" damping="{mount_n_s_per_m!r}"/>'
    for axis in ("1 0 0", "0 1 0", "0 0 1")
)
bodies, motors = "", ""
for index, (mass, centre, inertia) in enumerate(links):
    z = joints[0] if index == 0 else lengths[index - 1]
    damping = given["damping_s"] * stiffness[index]
    bodies += (
        f'<body pos="0 0 {z!r}"><joint name="j{index}" type="hinge" axis="0 1 0" '
        f'stiffness="{stiffness[index]!r}" damping="{damping!r}"/>'
        f'<inertial pos="0 0 {centre!r}" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>'
    )
    motors += f'<joint joint="j{index}" coef="{given["tendon_m"]!r}"/>'
text = (
    '<mujoco><option timestep="1e-5" gravity="0 0 0" integrator="Euler"><flag eulerdamp="disable"/></option>'
    f'<worldbody><body>{slides}<inertial pos="0 0 {shaft_m!r}" mass="{shaft_kg!r}" '
    f'diaginertia="1e-9 1e-9 1e-9"/>{bodies}{"</body>" * (len(links) + 1)}</worldbody>'
    f'<tendon><fixed name="cable">{motors}</fixed></tendon>'
    '<actuator><motor tendon="cable"/></actuator></mujoco>'
)
model = mujoco.MjModel.from_xml_string(text)
data = mujoco.MjData(model)
n, h = model.nv, model.opt.timestep
a, b = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, model.nu))
mujoco.mjd_transitionFD(model, data, 1e-6, True, a, b, None, None)
# Euler: v+ = v + h M^-1 (tau - K q - D v).
theirs = [-a[n:, :n] / h, (np.eye(n) - a[n:, n:]) / h, b[n:] / h]
worst = []
for mine, other in zip(given["ours"], theirs, strict=True):
    mine = np.array(mine).reshape(other.shape)
    # A row of zeros, such as that of the mount across the bending plane, has only rounding.
    rows = np.abs(other).max(axis=1, keepdims=True).clip(1e-9 * np.abs(other).max())
    worst.append(float((np.abs(mine - other) / rows).max()))
print(json.dumps(worst))
