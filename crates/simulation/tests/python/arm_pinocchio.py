"""Poses and Jacobians of arms by Pinocchio, from their URDF files.

`folder` prints the folder of example-robot-data's files. `compare` reads poses and joint angles, one JSON
object per line, and prints the largest differences.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

if sys.argv[1] == "folder":
    package = Path(pin.__file__).resolve()
    above = next(folder for folder in package.parents if (folder / "share" / "example-robot-data").is_dir())
    print(json.dumps(str(above / "share" / "example-robot-data" / "robots")))
    sys.exit()

models = {}
worst = {"forward": 0.0, "jacobian": 0.0, "poses": 0}
for line in sys.stdin:
    case = json.loads(line)
    if case["file"] not in models:
        model = pin.buildModelFromUrdf(case["file"])
        models[case["file"]] = (model, model.createData())
    model, data = models[case["file"]]
    base, tip = (model.getFrameId(case[end], pin.FrameType.BODY) for end in ("base", "tip"))
    # The joints from base to tip.
    chain, joint = [], model.frames[tip].parentJoint
    while joint != model.frames[base].parentJoint:
        chain.insert(0, joint)
        joint = model.parents[joint]
    q = pin.neutral(model)
    for joint, angle in zip(chain, case["q_rad"], strict=True):
        place = model.joints[joint].idx_q
        if model.joints[joint].nq == 2:
            q[place : place + 2] = np.cos(angle), np.sin(angle)
        else:
            q[place] = angle
    pin.framesForwardKinematics(model, data, q)
    theirs = data.oMf[base].inverse() * data.oMf[tip]
    ours = np.array(case["pose"]).reshape(4, 4).T
    worst["forward"] = max(worst["forward"], np.abs(theirs.homogeneous - ours).max())
    jacobian = pin.computeFrameJacobian(model, data, q, tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    columns = [model.joints[joint].idx_v for joint in chain]
    turn = data.oMf[base].rotation.T
    theirs = np.vstack([turn @ jacobian[:3, columns], turn @ jacobian[3:, columns]])
    ours = np.array(case["jacobian"]).reshape(-1, 6).T
    worst["jacobian"] = max(worst["jacobian"], np.abs(theirs - ours).max())
    worst["poses"] += 1
print(json.dumps(worst))
