"""Compares poses and joint angles, one JSON object per line, with the modern_robotics library.

Prints the largest differences. modern_robotics (Lynch and Park) uses screw axes, not Denavit-Hartenberg
parameters. Its UR5 is built here from the lengths of "Modern Robotics" (2017), example 4.5; its space frame
is ours rotated by 180 degrees about z.
"""

import json
import sys

import modern_robotics as mr
import numpy as np

L1, L2, W1, W2, H1, H2 = 0.425, 0.39225, 0.10915, 0.0823, 0.089159, 0.09465
SCREWS = np.array(
    [
        [0, 0, 1, 0, 0, 0],
        [0, 1, 0, -H1, 0, 0],
        [0, 1, 0, -H1, 0, L1],
        [0, 1, 0, -H1, 0, L1 + L2],
        [0, 0, -1, -W1, L1 + L2, 0],
        [0, 1, 0, H2 - H1, 0, L1 + L2],
    ]
).T
HOME = np.array([[-1, 0, 0, L1 + L2], [0, 0, 1, W1 + W2], [0, 1, 0, H1 - H2], [0, 0, 0, 1]])
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])

worst = {"forward": 0.0, "inverse": 0.0, "jacobian": 0.0, "numeric": 0.0, "poses": 0, "solutions": 0}
for line in sys.stdin:
    case = json.loads(line)
    pose = np.array(case["pose"]).reshape(4, 4).T
    theirs = HALF_TURN @ mr.FKinSpace(HOME, SCREWS, case["q_rad"])
    worst["forward"] = max(worst["forward"], np.abs(theirs - pose).max())
    for solution in case["solutions_rad"]:
        theirs = HALF_TURN @ mr.FKinSpace(HOME, SCREWS, solution)
        worst["inverse"] = max(worst["inverse"], np.abs(theirs - pose).max())
        worst["solutions"] += 1
    # Newton iteration from nearby converges to our nearest solution.
    if worst["poses"] % 20 == 0:
        guess = np.array(case["q_rad"]) + 0.01
        found, converged = mr.IKinSpace(SCREWS, HOME, HALF_TURN @ pose, guess, 1e-12, 1e-12)
        assert converged, case
        worst["numeric"] = max(worst["numeric"], np.abs(found - case["nearest_rad"]).max())
        # The space Jacobian gives the velocity of the point at the origin; ours that of the tool.
        space = mr.JacobianSpace(SCREWS, case["q_rad"])
        turn = HALF_TURN[:3, :3]
        angular, origin = turn @ space[:3], turn @ space[3:]
        linear = origin + np.cross(angular.T, pose[:3, 3]).T
        ours = np.array(case["jacobian"]).reshape(6, 6).T
        worst["jacobian"] = max(worst["jacobian"], np.abs(np.vstack([linear, angular]) - ours).max())
    worst["poses"] += 1
print(json.dumps(worst))
