"""MuJoCo on the beam of `trabecula-lab chart physics`: a chain of hinges with springs, and its cable plugin.

Input: a folder with beam.json; for the output lines see lab/charts/physics/peers.rs.
"""
import json
import math
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

beam = json.loads((Path(sys.argv[1]) / "beam.json").read_text())
L, EI, RHO = beam["length_m"], beam["rigidity_nm2"], beam["density_kg_per_m"]
# Sum of the squared outer and inner radius of the tool's tube, for the links' own inertia.
TUBE_M2 = 3e-3 ** 2 + 2e-3 ** 2
# Damping ratio of the free vibration.
RATIO = 0.05
OMEGA = 1.875104068711961 ** 2 * math.sqrt(EI / RHO) / L ** 2
# Loads at the tip along the world axes, regardless of the tip's orientation: force across, moment in the
# plane.
LOADS = """
  <actuator>
    <motor site="tip" refsite="world" gear="1 0 0 0 0 0"/>
    <motor site="tip" refsite="world" gear="0 0 0 0 1 0"/>
  </actuator>
</mujoco>"""


def chain(links, dt_s, ratio, tube_m2=TUBE_M2):
    """Half a link, hinges at the flexures' centres, half a link, like our chains."""
    h, mass = L / links, RHO * L / links
    k = EI / h
    c = 2.0 * ratio / OMEGA * k
    bodies, close = "", ""
    for i in range(links):
        length = h if i < links - 1 else 0.5 * h
        m = mass * length / h
        # Rotary inertia of the tube: without it the chain diverges under the step moment at 1 ms.
        inertia = m * (length ** 2 / 12.0 + tube_m2 / 4.0)
        bodies += (
            f'<body pos="0 0 {0.5 * h if i == 0 else h}">'
            f'<joint type="hinge" axis="0 1 0" stiffness="{k!r}" damping="{c!r}"/>'
            f'<inertial pos="0 0 {0.5 * length}" mass="{m!r}" '
            f'diaginertia="{inertia!r} {inertia!r} {m * max(tube_m2, 1e-8) / 2.0!r}"/>')
        close += "</body>"
    text = (
        f'<mujoco><option timestep="{dt_s!r}" gravity="0 0 0" integrator="implicitfast"/>'
        f'<worldbody><site name="world"/>{bodies}'
        f'<site name="tip" pos="0 0 {0.5 * h}"/>{close}</worldbody>{LOADS}')
    return mujoco.MjModel.from_xml_string(text)


def cable(links, dt_s, ratio, tube_m2=TUBE_M2):
    """The cable plugin; the beam is along x, so the loads along the world's x are rotated to z."""
    # A section with the beam's rigidity and mass; the radius only divides them, and determines the links' own
    # inertia.
    r = math.sqrt(max(tube_m2, 1e-8))
    young, density = EI / (math.pi * r ** 4 / 4), RHO / (math.pi * r ** 2)
    c = 2.0 * ratio / OMEGA * EI / (L / links)
    loads = LOADS.replace('"tip"', '"S_last"')
    loads = loads.replace("1 0 0 0 0 0", "0 0 1 0 0 0").replace("0 0 0 0 1 0", "0 0 0 0 -1 0")
    text = f'''<mujoco><option timestep="{dt_s!r}" gravity="0 0 0" integrator="implicitfast"/>
      <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
      <worldbody><site name="world"/>
        <composite type="cable" curve="s" count="{links + 1} 1 1" size="{L}" initial="none">
          <plugin plugin="mujoco.elasticity.cable">
            <config key="twist" value="{young / 2.6!r}"/><config key="bend" value="{young!r}"/>
            <config key="flat" value="true"/>
          </plugin>
          <joint kind="main" damping="{c!r}"/>
          <geom type="cylinder" size="{r}" density="{density!r}" contype="0" conaffinity="0"/>
        </composite>
      </worldbody>{loads}'''
    return mujoco.MjModel.from_xml_string(text)


def place(model, data, along_x):
    name = "S_last" if along_x else "tip"
    x, _, z = data.site(name).xpos
    return (z, x) if along_x else (x, z)


def run(model, seconds, force, moment):
    """Returns the rest state after a duration, and the median time of a simulated millisecond."""
    data = mujoco.MjData(model)
    data.ctrl[:] = force, moment
    steps = max(1, round(1e-3 / model.opt.timestep))
    times = []
    for _ in range(round(seconds / (steps * model.opt.timestep))):
        began = time.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        times.append((time.perf_counter() - began) * 1e6 / (steps * model.opt.timestep * 1e3))
    return data, float(np.median(times))


def frequency(make, links, dt_s, along_x):
    """Releases the chain from the shape under a small force; returns the time between the first and the last
    of ten downward zero crossings.
    """
    still, _ = run(make(links, dt_s, 1.0), 0.6, 0.01, 0.0)
    model = make(links, dt_s, RATIO, 0.0)
    data = mujoco.MjData(model)
    data.qpos[:] = still.qpos
    times, crossings, last = [], [], None
    while len(crossings) < 11 and data.time < 0.5:
        began = time.perf_counter()
        mujoco.mj_step(model, data)
        times.append((time.perf_counter() - began) * 1e6 * 1e-3 / dt_s)
        x = place(model, data, along_x)[0]
        if not math.isfinite(x) or abs(x) > 1.0:
            return float(np.median(times)), float("nan")
        if last is not None and last > 0.0 >= x:
            crossings.append(data.time - dt_s * x / (x - last))
        last = x
    if len(crossings) < 11:
        return float(np.median(times)), float("nan")
    # The damped frequency, corrected for its damping.
    hz = 10.0 / (crossings[-1] - crossings[0]) / math.sqrt(1.0 - RATIO ** 2)
    return float(np.median(times)), hz


for label, make, along_x in (("mujoco", chain, False), ("mujoco_cable", cable, True)):
    for links in beam["links"]:
        dt_ms = 1.0
        data, us = run(make(links, dt_ms * 1e-3, 1.0), 0.6, 0.0, beam["end_moment_nm"])
        print("end_moment", label, links, dt_ms, us, 0, *place(None, data, along_x), flush=True)
        for load in beam["loads"]:
            data, us = run(make(links, dt_ms * 1e-3, 1.0), 0.6, load * EI / L ** 2, 0.0)
            print("tip_force", label, links, dt_ms, us, load, *place(None, data, along_x), flush=True)
    for dt_ms in beam["dt_ms"]:
        us, hz = frequency(make, beam["vibration_links"], dt_ms * 1e-3, along_x)
        print("vibration", label, beam["vibration_links"], dt_ms, us, 0, hz, 0, flush=True)
