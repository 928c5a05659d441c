// Where the arm's joints are: the UR5's Denavit-Hartenberg frames, walked back from its flange.

import { add, rotate } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Pose} Pose */
/** @typedef {import("/assets/vector.js").Quaternion} Quaternion */

/** Length a and offset d in metres, twist alpha in radians, joint by joint (Universal Robots, "DH parameters", UR5). */
const JOINTS = [
  { a: 0, d: 0.089159, alpha: Math.PI / 2 }, { a: -0.425, d: 0, alpha: 0 }, { a: -0.39225, d: 0, alpha: 0 },
  { a: 0, d: 0.10915, alpha: Math.PI / 2 }, { a: 0, d: 0.09465, alpha: -Math.PI / 2 }, { a: 0, d: 0.0823, alpha: 0 },
];

/** @param {Quaternion} a @param {Quaternion} b @returns {Quaternion} */
function product([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
  ];
}

/**
 * Poses of the arm's base and of the frames behind its joints but the last, whose frame is the flange.
 * @param {Pose} flange @param {number[]} angles joint angles in radians @returns {Pose[]}
 */
export function armFrames(flange, angles) {
  const frames = [];
  let pose = flange;
  for (let i = JOINTS.length - 1; i >= 0; i--) {
    const { a, d, alpha } = JOINTS[i];
    // Backwards through Rz(theta) Tz(d) Tx(a) Rx(alpha).
    const untwisted = product(pose.rotation, [Math.sin(-alpha / 2), 0, 0, Math.cos(alpha / 2)]);
    const moved = add(pose.position, rotate(untwisted, [-a, 0, -d]));
    pose = { position: moved, rotation: product(untwisted, [0, 0, Math.sin(-angles[i] / 2), Math.cos(angles[i] / 2)]) };
    frames.unshift(pose);
  }
  return frames;
}
