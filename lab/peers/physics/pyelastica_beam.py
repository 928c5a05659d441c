"""PyElastica's Cosserat rod on the beam of `trabecula-lab chart physics`.

Input: a folder with beam.json; for the output lines see lab/charts/physics/peers.rs. The step is limited by
the stretch of the rod, so every problem runs only until it settles.
"""
import json
import math
import sys
import time
from pathlib import Path

import elastica as ea
import numpy as np

beam = json.loads((Path(sys.argv[1]) / "beam.json").read_text())
L, EI, RHO = beam["length_m"], beam["rigidity_nm2"], beam["density_kg_per_m"]
OMEGA = 1.875104068711961 ** 2 * math.sqrt(EI / RHO) / L ** 2
# A section with EA = 2e4 N: it stretches by 20 um under the largest load, and its shear wave limits the step
# to 2 us.
RADIUS = 2.0 * math.sqrt(EI / 2e4)
YOUNG, DENSITY = 2e4 / (math.pi * RADIUS ** 2), RHO / (math.pi * RADIUS ** 2)


class World(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
    """A clamped rod."""


class EndMoment(ea.NoForces):
    """A moment about the world's y on the last element, ramped up within 30 ms."""

    def __init__(self, moment_nm):
        self.moment = np.array([0.0, moment_nm, 0.0])

    def apply_torques(self, system, time=0.0):
        share = min(1.0, float(time) / 0.03)
        system.external_torques[..., -1] += system.director_collection[..., -1] @ (share * self.moment)


def world(elements, dt_s, force_n, moment_nm, ratio):
    rod = ea.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), L, RADIUS, DENSITY,
        youngs_modulus=YOUNG, shear_modulus=YOUNG / 2.6)
    scene = World()
    scene.append(rod)
    scene.constrain(rod).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    if force_n:
        scene.add_forcing_to(rod).using(
            ea.EndpointForces, np.zeros(3), np.array([force_n, 0.0, 0.0]), ramp_up_time=0.03)
    if moment_nm:
        scene.add_forcing_to(rod).using(EndMoment, moment_nm)
    scene.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=2.0 * ratio * OMEGA, time_step=dt_s)
    scene.finalize()
    return scene, rod


def run(scene, dt_s, seconds, begin=0.0):
    """Continues stepping; returns the mean processor time of a simulated millisecond."""
    stepper, steps = ea.PositionVerlet(), round(seconds / dt_s)
    now, began = np.float64(begin), time.process_time()
    for _ in range(steps):
        now = stepper.step(scene, now, np.float64(dt_s))
    return (time.process_time() - began) * 1e6 / (steps * dt_s * 1e3), now


def tip(rod):
    return rod.position_collection[0, -1], rod.position_collection[2, -1]


elements = 13
dt_s = 1e-6
# Compilation by numba is not timed.
run(world(elements, dt_s, 1e-3, 1e-6, 1.0)[0], dt_s, 1e-4)
scene, rod = world(elements, dt_s, 0.0, beam["end_moment_nm"], 1.0)
us, _ = run(scene, dt_s, 0.1)
print("end_moment", "pyelastica", elements, dt_s * 1e3, us, 0, *tip(rod), flush=True)
load = beam["loads"][-1]
scene, rod = world(elements, dt_s, load * EI / L ** 2, 0.0, 1.0)
us, _ = run(scene, dt_s, 0.1)
print("tip_force", "pyelastica", elements, dt_s * 1e3, us, load, *tip(rod), flush=True)

# Bent by a small force and released: four downward zero crossings.
ratio = 0.02
scene, rod = world(elements, dt_s, 0.01, 0.0, 1.0)
us, _ = run(scene, dt_s, 0.08)
free, swinging = world(elements, dt_s, 0.0, 0.0, ratio)
for name in ("position_collection", "director_collection"):
    getattr(swinging, name)[...] = getattr(rod, name)
crossings, last, now, spent = [], None, np.float64(0.0), 0.0
stepper = ea.PositionVerlet()
while len(crossings) < 4 and now < 0.2:
    began = time.process_time()
    now = stepper.step(free, now, np.float64(dt_s))
    spent += time.process_time() - began
    x = tip(swinging)[0]
    if last is not None and last > 0.0 >= x:
        crossings.append(float(now) - dt_s * x / (x - last))
    last = x
hz = 3.0 / (crossings[-1] - crossings[0]) / math.sqrt(1.0 - ratio ** 2)
print("vibration", "pyelastica", elements, dt_s * 1e3, spent * 1e3 / float(now), 0, hz, 0, flush=True)
