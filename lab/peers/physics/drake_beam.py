"""Drake on the beam of `trabecula-lab chart physics`: a chain of hinges with spring force elements, stepped
by its discrete solver.

Input: a folder with beam.json; for the output lines see lab/charts/physics/peers.rs. Springs are explicit in
Drake and joint dampers implicit: with little damping its step is bounded, as the vibration shows.
"""
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame, RevoluteJoint, RevoluteSpring, SpatialInertia, UnitInertia)
from pydrake.systems.analysis import Simulator

beam = json.loads((Path(sys.argv[1]) / "beam.json").read_text())
L, EI, RHO = beam["length_m"], beam["rigidity_nm2"], beam["density_kg_per_m"]
# Sum of the squared outer and inner radius of the tool's tube, for the links' own inertia.
TUBE_M2 = 3e-3 ** 2 + 2e-3 ** 2
RATIO = 0.05
OMEGA = 1.875104068711961 ** 2 * math.sqrt(EI / RHO) / L ** 2


class Chain:
    """Half a link, hinges at the flexures' centres, half a link, like our chains."""

    def __init__(self, links, dt_s, ratio, tube_m2=TUBE_M2):
        self.dt_s, self.plant = dt_s, MultibodyPlant(time_step=dt_s)
        plant = self.plant
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        h, mass = L / links, RHO * L / links
        k = EI / h
        frame, offset, self.joints = plant.world_frame(), 0.5 * h, []
        for i in range(links):
            length = h if i < links - 1 else 0.5 * h
            m = mass * length / h
            across, along = length ** 2 / 12.0 + tube_m2 / 4.0, max(tube_m2, 1e-8) / 2.0
            inertia = SpatialInertia(
                m, np.array([0.0, 0.0, 0.5 * length]),
                UnitInertia(across, across, along).ShiftFromCenterOfMass(np.array([0.0, 0.0, -0.5 * length])))
            body = plant.AddRigidBody(f"link{i}", inertia)
            near = plant.AddFrame(
                FixedOffsetFrame(f"near{i}", frame, RigidTransform(np.array([0.0, 0.0, offset]))))
            joint = plant.AddJoint(RevoluteJoint(
                f"joint{i}", near, body.body_frame(), np.array([0.0, 1.0, 0.0]),
                damping=2.0 * ratio / OMEGA * k))
            plant.AddForceElement(RevoluteSpring(joint, nominal_angle=0.0, stiffness=k))
            self.joints.append(joint)
            frame, offset, self.tip = body.body_frame(), h, body
        plant.Finalize()
        self.end = np.array([0.0, 0.0, 0.5 * h])
        self.simulator = Simulator(plant)
        self.context = self.simulator.get_mutable_context()

    def load(self, force_n, moment_nm):
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.tip.index()
        applied.p_BoBq_B = self.end
        applied.F_Bq_W = SpatialForce(np.array([0.0, moment_nm, 0.0]), np.array([force_n, 0.0, 0.0]))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.context, [applied])

    def place(self):
        x, _, z = self.tip.EvalPoseInWorld(self.context).multiply(self.end)
        return x, z

    def run(self, seconds):
        """Continues stepping; returns the median time of a simulated millisecond. If the solver refuses,
        there is no position.
        """
        times, begin = [], self.context.get_time()
        each = max(self.dt_s, 1e-3)
        try:
            for k in range(round(seconds / each)):
                began = time.perf_counter()
                self.simulator.AdvanceTo(begin + (k + 1) * each)
                times.append((time.perf_counter() - began) * 1e6 / (each * 1e3))
        except RuntimeError:
            return float("nan")
        return float(np.median(times))


def frequency(links, dt_s):
    """Releases the chain from the shape under a small force; returns the time between the first and the last
    of ten downward zero crossings.
    """
    still = Chain(links, 1e-3, 1.0)
    still.load(0.01, 0.0)
    still.run(0.6)
    chain = Chain(links, dt_s, RATIO, 0.0)
    for joint, own in zip(chain.joints, still.joints):
        joint.set_angle(chain.context, own.get_angle(still.context))
    times, crossings, last, step = [], [], None, 0
    try:
        while len(crossings) < 11 and step * dt_s < 0.5:
            step += 1
            began = time.perf_counter()
            chain.simulator.AdvanceTo(step * dt_s)
            times.append((time.perf_counter() - began) * 1e6 * 1e-3 / dt_s)
            x, _ = chain.place()
            if not math.isfinite(x) or abs(x) > 1.0:
                break
            if last is not None and last > 0.0 >= x:
                crossings.append(step * dt_s - dt_s * x / (x - last))
            last = x
    except RuntimeError:
        pass
    us = float(np.median(times)) if times else float("nan")
    if len(crossings) < 11:
        return us, float("nan")
    # The damped frequency, corrected for its damping.
    return us, 10.0 / (crossings[-1] - crossings[0]) / math.sqrt(1.0 - RATIO ** 2)


dt_ms = 1.0
for links in beam["links"]:
    chain = Chain(links, dt_ms * 1e-3, 1.0)
    chain.load(0.0, beam["end_moment_nm"])
    us = chain.run(0.6)
    print("end_moment drake", links, dt_ms, us, 0, *chain.place(), flush=True)
    for share in beam["loads"]:
        chain = Chain(links, dt_ms * 1e-3, 1.0)
        chain.load(share * EI / L ** 2, 0.0)
        us = chain.run(0.6)
        print("tip_force drake", links, dt_ms, us, share, *chain.place(), flush=True)
for dt_ms in beam["dt_ms"]:
    us, hz = frequency(beam["vibration_links"], dt_ms * 1e-3)
    print("vibration drake", beam["vibration_links"], dt_ms, us, 0, hz, 0, flush=True)
