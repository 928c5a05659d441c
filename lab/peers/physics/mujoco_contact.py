"""MuJoCo in the contact problem of `trabecula-lab chart physics --peers`: `mujoco` and `mujoco_soft_joints`.

Input: a folder with contact.json; for the output lines see lab/charts/physics/contact.rs.

Its contacts are soft constraints, not springs: at rest a contact carries stiffness / ((1 - d) A) times its
overlap, with the direct stiffness of solref, the impedance d of solimp, and A, the inverse mass of its bodies
in the straight pose. With the maximum d of 0.9999, a separate stiffness for every pair gives the stated
newtons per metre at rest; the behaviour in motion is MuJoCo's own.

Its contact forces are found with the bare masses, while the integrator adds the dampers of the joints: if the
dampers outweigh the masses in a step, contacts do not achieve the requested motion, and `mujoco` oscillates.
`mujoco_soft_joints` has the springs and dampers of the hinges as soft constraints of the same solver, at the
stated stiffness and damping.
"""
import json
import math
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

problem = json.loads((Path(sys.argv[1]) / "contact.json").read_text())
IMPEDANCE = 0.9999
# Maximum of a soft joint's stiffness over inertia, as a fraction of 1 / dt², so that a step resolves it.
SOFT_JOINT = 0.25
# Maximum of its damping over inertia, as a fraction of 1 / dt: critical damping of the tool at 1 ms is larger
# and is not reached.
SOFT_DAMPER = 0.5
HALF_TURN = math.pi


def xml(walls, joint, dt_s, more):
    """`joint` gives the attributes of a hinge, `more` the constraints."""
    k, length, mass, inertia, along, radius = (
        problem[name] for name in (
            "stiffness_nm_per_rad", "length_m", "mass_kg", "inertia_kg_m2", "sphere_along_m",
            "sphere_radius_m"))
    touched = {wall["link"] for wall in walls}
    planes = "".join(
        f'<geom name="wall{i}" type="plane" size="0 0 1" contype="0" conaffinity="0"'
        f' pos="{wall["point_m"][0]!r} 0 {wall["point_m"][1]!r}"'
        f' zaxis="{wall["normal"][0]!r} 0 {wall["normal"][1]!r}"/>'
        for i, wall in enumerate(walls))
    bodies = ""
    for i in range(len(k)):
        offset = problem["first_hinge_m"] if i == 0 else length[i - 1]
        bodies += (
            f'<body name="link{i}" pos="0 0 {offset!r}"><joint name="hinge{i}" axis="0 1 0" {joint(k[i])}/>'
            f'<inertial pos="0 0 {0.5 * length[i]!r}" mass="{mass[i]!r}"'
            f' diaginertia="{inertia[i]!r} {inertia[i]!r} {inertia[i]!r}"/>')
        if i in touched:
            bodies += (
                f'<geom name="ball{i}" type="sphere" size="{radius!r}" pos="0 0 {along[i]!r}" mass="0"'
                f' contype="0" conaffinity="0"/>')
    return (
        f'<mujoco><compiler inertiafromgeom="false"/>'
        f'<option timestep="{dt_s!r}" gravity="0 0 0" integrator="implicitfast"/>'
        f'<worldbody><site name="world"/>{planes}{bodies}'
        f'<site name="tip" pos="0 0 {length[-1]!r}"/>{"</body>" * len(k)}</worldbody>'
        f'{more}<actuator><motor site="tip" refsite="world" gear="1 0 0 0 0 0"/></actuator></mujoco>')


def soft(stiffness, damping, impedance):
    return f'solref="{-stiffness!r} {-damping!r}" solimp="{impedance!r} {impedance!r} 0.001 0.5 2"/>'


def contacts(bare, walls, dt_s):
    """Returns each pair's direct stiffness and damping, limited to what one step of this length can
    resolve.
    """
    text = ""
    for i, wall in enumerate(walls):
        inverse_kg = float(bare.body_invweight0[bare.body(f'link{wall["link"]}').id][0])
        stiffness = problem["contact_stiffness_n_per_m"] * (1.0 - IMPEDANCE) * inverse_kg
        damping = min(2.0 * math.sqrt(stiffness), 1.0 / dt_s)
        text += (
            f'<pair geom1="wall{i}" geom2="ball{wall["link"]}" condim="1" '
            f'{soft(stiffness, damping, IMPEDANCE)}')
    return f"<contact>{text}</contact>"


def soft_joints(bare, ratio, dt_s):
    """Springs and dampers as constraints; the impedance keeps the stated stiffness resolvable by a step."""
    text = ""
    for i, k in enumerate(problem["stiffness_nm_per_rad"]):
        inverse = float(bare.dof_invweight0[i])
        share = min(max(SOFT_JOINT / (k * inverse * dt_s ** 2), 1.0 - IMPEDANCE), IMPEDANCE)
        stiffness = k * share * inverse
        damping = min(stiffness * ratio * problem["damping_s"], SOFT_DAMPER / dt_s)
        text += f'<joint joint1="hinge{i}" polycoef="0 0 0 0 0" {soft(stiffness, damping, 1.0 - share)}'
    return f"<equality>{text}</equality>"


def model_of(walls, ratio, dt_s, name):
    bare = mujoco.MjModel.from_xml_string(xml(walls, lambda k: "", dt_s, ""))
    if name == "mujoco":
        def joint(k):
            return f'stiffness="{k!r}" damping="{ratio * problem["damping_s"] * k!r}"'
        return mujoco.MjModel.from_xml_string(xml(walls, joint, dt_s, contacts(bare, walls, dt_s)))
    constraints = contacts(bare, walls, dt_s) + soft_joints(bare, ratio, dt_s)
    return mujoco.MjModel.from_xml_string(xml(walls, lambda k: "", dt_s, constraints))


def rest(walls, ratio, dt_s, name):
    """Returns the median time of a simulated millisecond, and the final angles."""
    model = model_of(walls, ratio, dt_s, name)
    data, times, steps = mujoco.MjData(model), [], max(1, round(1e-3 / dt_s))
    for k in range(round(problem["seconds"] * 1e3)):
        data.ctrl[0] = problem["tip_force_n"] * min(1.0, (k + 1) * 1e-3 / problem["ramp_s"])
        began = time.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        times.append((time.perf_counter() - began) * 1e6)
        # MuJoCo restarts from the straight pose if it diverges.
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.all(np.abs(data.qpos) < HALF_TURN):
            return float(np.median(times)), np.full(model.nq, np.nan)
    return float(np.median(times)), data.qpos


for walls in problem["cases"]:
    for name in ("mujoco", "mujoco_soft_joints"):
        for ratio, dt_ms in problem["settings"]:
            us, angle = rest(walls, ratio, dt_ms * 1e-3, name)
            print("contact", name, len(walls), ratio, dt_ms, us, *angle, flush=True)
