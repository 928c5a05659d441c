"""Poses and Jacobians of arms by yourdfpy and MuJoCo, from their URDF files.

Reads poses and joint angles, one JSON object per line, and prints the largest differences. yourdfpy has no
Jacobian.
"""

import json
import sys
import xml.etree.ElementTree as ElementTree
from typing import Any

import mujoco
import numpy as np
import yourdfpy

Pose = np.ndarray[Any, np.dtype[np.float64]]


class MuJoCo:
    """A URDF file without its shapes; each link is a separate body."""

    def __init__(self, file: str) -> None:
        robot = ElementTree.parse(file).getroot()
        self.root = next(iter({link.get("name") for link in robot.iter("link")} - {child.get("link") for child in robot.iter("child")}))
        for link in robot.iter("link"):
            for shape in link.findall("visual") + link.findall("collision"):
                link.remove(shape)
        compiler = ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler")
        # Bodies need masses; poses do not depend on them.
        compiler.attrib.update(fusestatic="false", boundmass="1", boundinertia="1", balanceinertia="true")
        self.model = mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))
        self.data = mujoco.MjData(self.model)

    def body(self, link: str) -> int:
        return 0 if link == self.root else self.model.body(link).id

    def chain(self, base: str, tip: str) -> list[int]:
        """Joints from base to tip."""
        found, body = [], self.body(tip)
        while body != self.body(base):
            found[:0] = range(self.model.body_jntadr[body], self.model.body_jntadr[body] + self.model.body_jntnum[body])
            body = self.model.body_parentid[body]
        return found

    def of(self, base: str, tip: str, q_rad: list[float]) -> tuple[Pose, Pose]:
        """Pose of the tip in the base, and the Jacobian in the base's axes."""
        joints = self.chain(base, tip)
        for joint, angle in zip(joints, q_rad, strict=True):
            self.data.qpos[self.model.jnt_qposadr[joint]] = angle
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        base_id, tip_id = self.body(base), self.body(tip)
        turn = self.data.xmat[base_id].reshape(3, 3).T
        pose = np.eye(4)
        pose[:3, :3] = turn @ self.data.xmat[tip_id].reshape(3, 3)
        pose[:3, 3] = turn @ (self.data.xpos[tip_id] - self.data.xpos[base_id])
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jacBody(self.model, self.data, linear, angular, tip_id)
        columns = [self.model.jnt_dofadr[joint] for joint in joints]
        return pose, np.vstack([turn @ linear[:, columns], turn @ angular[:, columns]])


def names(robot: yourdfpy.URDF, base: str, tip: str) -> list[str]:
    """Movable joints, from base to tip."""
    above = {joint.child: joint for joint in robot.robot.joints}
    found, link = [], tip
    while link != base:
        joint = above[link]
        link = joint.parent
        if joint.type != "fixed":
            found.insert(0, joint.name)
    return found


worst = {"yourdfpy": 0.0, "mujoco": 0.0, "mujoco_jacobian": 0.0, "poses": 0}
readers: dict[str, tuple[yourdfpy.URDF, MuJoCo]] = {}
for line in sys.stdin:
    case = json.loads(line)
    file, base, tip = case["file"], case["base"], case["tip"]
    if file not in readers:
        readers[file] = yourdfpy.URDF.load(file, load_meshes=False, load_collision_meshes=False), MuJoCo(file)
    robot, model = readers[file]
    ours = np.array(case["pose"]).reshape(4, 4).T
    robot.update_cfg(dict(zip(names(robot, base, tip), case["q_rad"], strict=True)))
    worst["yourdfpy"] = max(worst["yourdfpy"], np.abs(robot.get_transform(tip, base) - ours).max())
    pose, jacobian = model.of(base, tip, case["q_rad"])
    worst["mujoco"] = max(worst["mujoco"], np.abs(pose - ours).max())
    difference = jacobian - np.array(case["jacobian"]).reshape(-1, 6).T
    worst["mujoco_jacobian"] = max(worst["mujoco_jacobian"], np.abs(difference).max())
    worst["poses"] += 1
print(json.dumps(worst))
