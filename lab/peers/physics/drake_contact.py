"""Drake in the contact problem of `trabecula-lab chart physics --peers`: its discrete SAP solver with
compliant point contact.

Input: a folder with contact.json; for the output lines see lab/charts/physics/contact.rs. `drake` has the
stated stiffness, as two springs in series, and no near-rigid regularisation, which would soften contacts that
are stiffer than a step resolves. `drake_near_rigid` keeps that regularisation, which is Drake's default.
"""
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    AddContactMaterial, Box, CollisionFilterDeclaration, GeometrySet, ProximityProperties, SceneGraph, Sphere)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlant, CoulombFriction, ExternallyAppliedSpatialForce, MultibodyPlantConfig)
from pydrake.multibody.tree import (
    FixedOffsetFrame, RevoluteJoint, RevoluteSpring, SpatialInertia, UnitInertia)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

problem = json.loads((Path(sys.argv[1]) / "contact.json").read_text())
DEFAULT_NEAR_RIGID = MultibodyPlantConfig().sap_near_rigid_threshold
# Wide, wide, thick.
BLOCK_M = (0.1, 0.1, 0.02)


def material():
    """Two equal springs in series give the stated stiffness; no friction."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=None, point_stiffness=2.0 * problem["contact_stiffness_n_per_m"],
        friction=CoulombFriction(0.0, 0.0),
        properties=properties)
    properties.AddProperty("material", "relaxation_time", 0.0)
    return properties


class Chain:
    """The stated hinges, springs, masses and walls."""

    def __init__(self, walls, ratio, dt_s, near_rigid):
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=dt_s, discrete_contact_approximation="sap", contact_model="point")
        config.sap_near_rigid_threshold = near_rigid
        self.plant, self.scene = AddMultibodyPlant(config, builder)
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self.joints, self.bodies = [], []
        for i in range(len(problem["length_m"])):
            self.add_link(i, ratio)
        self.add_walls(walls)
        self.plant.Finalize()
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def add_link(self, i, ratio):
        plant, k, length, mass = (
            self.plant, problem["stiffness_nm_per_rad"][i], problem["length_m"], problem["mass_kg"][i])
        parent = self.bodies[-1].body_frame() if self.bodies else plant.world_frame()
        offset = length[i - 1] if self.bodies else problem["first_hinge_m"]
        share = problem["inertia_kg_m2"][i] / mass
        centre = np.array([0.0, 0.0, 0.5 * length[i]])
        inertia = SpatialInertia(
            mass, centre, UnitInertia(share, share, share).ShiftFromCenterOfMass(-centre))
        body = plant.AddRigidBody(f"link{i}", inertia)
        near = plant.AddFrame(
            FixedOffsetFrame(f"near{i}", parent, RigidTransform(np.array([0.0, 0.0, offset]))))
        joint = plant.AddJoint(RevoluteJoint(
            f"joint{i}", near, body.body_frame(), np.array([0.0, 1.0, 0.0]),
            damping=ratio * problem["damping_s"] * k))
        plant.AddForceElement(RevoluteSpring(joint, nominal_angle=0.0, stiffness=k))
        self.joints.append(joint)
        self.bodies.append(body)

    def add_walls(self, walls):
        """A sphere touches only its own two planes."""
        balls, planes = {}, []
        for i, wall in enumerate(walls):
            link = wall["link"]
            if link not in balls:
                place = RigidTransform(np.array([0.0, 0.0, problem["sphere_along_m"][link]]))
                balls[link] = self.plant.RegisterCollisionGeometry(
                    self.bodies[link], place, Sphere(problem["sphere_radius_m"]), f"ball{link}", material())
            (x, z), (nx, nz) = wall["point_m"], wall["normal"]
            # The front face of a wide block: with 30 half-spaces Drake 1.51.1 crashes, with 10 it does not.
            turn = RotationMatrix.MakeYRotation(math.atan2(nx, nz))
            pose = RigidTransform(turn, np.array([x, 0.0, z]) - 0.5 * BLOCK_M[2] * np.array([nx, 0.0, nz]))
            planes.append((link, self.plant.RegisterCollisionGeometry(
                self.plant.world_body(), pose, Box(*BLOCK_M), f"wall{i}", material())))
        apart = CollisionFilterDeclaration().ExcludeWithin(GeometrySet(list(balls.values())))
        for link, plane in planes:
            others = [ball for other, ball in balls.items() if other != link]
            apart.ExcludeBetween(GeometrySet([plane]), GeometrySet(others))
        self.scene.collision_filter_manager().Apply(apart)

    def pull(self, force_n):
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.bodies[-1].index()
        applied.p_BoBq_B = np.array([0.0, 0.0, problem["length_m"][-1]])
        applied.F_Bq_W = SpatialForce(np.zeros(3), np.array([force_n, 0.0, 0.0]))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.context, [applied])


def rest(walls, ratio, dt_s, near_rigid):
    """Returns the median time of a simulated millisecond and the final angles; none if the solver refuses."""
    chain, times = Chain(walls, ratio, dt_s, near_rigid), []
    try:
        for k in range(round(problem["seconds"] * 1e3)):
            chain.pull(problem["tip_force_n"] * min(1.0, (k + 1) * 1e-3 / problem["ramp_s"]))
            began = time.perf_counter()
            chain.simulator.AdvanceTo((k + 1) * 1e-3)
            times.append((time.perf_counter() - began) * 1e6)
    except RuntimeError as cause:
        print("refused:", str(cause).splitlines()[0], flush=True)
        return (float(np.median(times)) if times else float("nan")), [float("nan")] * len(chain.joints)
    return float(np.median(times)), [joint.get_angle(chain.context) for joint in chain.joints]


for walls in problem["cases"]:
    for name, near_rigid in (("drake", 0.0), ("drake_near_rigid", DEFAULT_NEAR_RIGID)):
        for ratio, dt_ms in problem["settings"]:
            us, angle = rest(walls, ratio, dt_ms * 1e-3, near_rigid)
            print("contact", name, len(walls), ratio, dt_ms, us, *angle, flush=True)
