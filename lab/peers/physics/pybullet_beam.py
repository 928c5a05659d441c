"""PyBullet on the beam of `trabecula-lab chart physics`: its reduced-coordinate chain of hinges.

Input: a folder with beam.json; for the output lines see lab/charts/physics/peers.rs. Its API has no joint
springs: the springs are torques set before every step, so the step is bounded as in any explicit method.
Damped by PyBullet's own damping of bodies.
"""
import json
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pybullet as bullet

beam = json.loads((Path(sys.argv[1]) / "beam.json").read_text())
L, EI, RHO = beam["length_m"], beam["rigidity_nm2"], beam["density_kg_per_m"]
TUBE_M2 = 3e-3 ** 2 + 2e-3 ** 2
OMEGA = 1.875104068711961 ** 2 * math.sqrt(EI / RHO) / L ** 2
# Fixed bodies also need an inertia.
MASSLESS = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
# Critically damped: at rest to within a millionth after 0.1 s.
SECONDS, RAMP_S = 0.1, 0.03


def urdf(links):
    """Half a link, hinges at the flexures' centres, half a link, like our chains."""
    h, mass = L / links, RHO * L / links
    text = '<robot name="beam"><link name="l0">' + MASSLESS + '</link>'
    for i in range(links):
        length = h if i < links - 1 else 0.5 * h
        m = mass * length / h
        across, along = m * (length ** 2 / 12.0 + TUBE_M2 / 4.0), m * TUBE_M2 / 2.0
        text += (
            f'<link name="l{i + 1}"><inertial><origin xyz="0 0 {0.5 * length!r}"/><mass value="{m!r}"/>'
            f'<inertia ixx="{across!r}" iyy="{across!r}" izz="{along!r}"'
            f' ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="j{i + 1}" type="continuous"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><axis xyz="0 1 0"/>'
            f'<origin xyz="0 0 {0.5 * h if i == 0 else h!r}"/></joint>')
    return text + "</robot>"


def rest(links, dt_s, force_n, moment_nm):
    """Returns the cost of a simulated millisecond, and the tip position after a duration."""
    h = L / links
    k = EI / h
    bullet.resetSimulation()
    bullet.setGravity(0, 0, 0)
    bullet.setTimeStep(dt_s)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "beam.urdf"
        path.write_text(urdf(links))
        body = bullet.loadURDF(str(path), useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE)
    joints = list(range(links))
    bullet.setJointMotorControlArray(body, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * links)
    for joint in joints:
        bullet.changeDynamics(
            body, joint, linearDamping=2.0 * OMEGA, angularDamping=2.0 * OMEGA, jointDamping=0.0,
            maxJointVelocity=1e9)
    angle, times = np.zeros(links), []
    for step in range(round(SECONDS / dt_s)):
        share = min(1.0, step * dt_s / RAMP_S)
        began = time.perf_counter()
        bullet.setJointMotorControlArray(body, joints, bullet.TORQUE_CONTROL, forces=list(-k * angle))
        if moment_nm:
            # A link's torque in the world; about y it is the same in both frames.
            bullet.applyExternalTorque(body, links - 1, [0.0, share * moment_nm, 0.0], bullet.LINK_FRAME)
        if force_n:
            bullet.applyExternalForce(
                body, links - 1, [share * force_n, 0.0, 0.0], place(body, links), bullet.WORLD_FRAME)
        bullet.stepSimulation()
        angle = np.array([state[0] for state in bullet.getJointStates(body, joints)])
        times.append((time.perf_counter() - began) * 1e6)
        if not np.all(np.abs(angle) < 10.0):
            return float(np.median(times)) * 1e-3 / dt_s, (math.nan, math.nan)
    x, _, z = place(body, links)
    return float(np.median(times)) * 1e-3 / dt_s, (x, z)


def place(body, links):
    """Returns the tip in the world: half a link beyond the last hinge."""
    state = bullet.getLinkState(body, links - 1, computeForwardKinematics=True)
    turned = bullet.multiplyTransforms(state[4], state[5], [0.0, 0.0, 0.5 * L / links], [0.0, 0.0, 0.0, 1.0])
    return turned[0]


bullet.connect(bullet.DIRECT)
# One millisecond, and step sizes that springs as torques allow.
for links, dt_ms in ((4, 1.0), (4, 0.02), (8, 0.01), (26, 0.005)):
    us, tip = rest(links, dt_ms * 1e-3, 0.0, beam["end_moment_nm"])
    print("end_moment pybullet", links, dt_ms, us, 0, *tip, flush=True)
    load = beam["loads"][-1]
    us, tip = rest(links, dt_ms * 1e-3, load * EI / L ** 2, 0.0)
    print("tip_force pybullet", links, dt_ms, us, load, *tip, flush=True)
