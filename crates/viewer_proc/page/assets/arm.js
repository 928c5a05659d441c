// The arm's link frames, computed backward from its flange.

import { product, rotate, subtract } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Pose} Pose */
/** @typedef {{position_m: import("/assets/vector.js").Vector, orientation_xyzw: import("/assets/vector.js").Quaternion}} Part */

/**
 * Returns the frames of the arm's links, from the base to the one before the flange; empty without an arm.
 * Frame i + 1 is frame i rotated about its z by joint i + 1, then moved by part i.
 * @param {Pose} flange @param {number[]} angles joint angles in radians @param {Part[]} parts of `/view/info` @returns {Pose[]}
 */
export function armFrames(flange, angles, parts) {
  const frames = [];
  let pose = flange;
  for (let i = parts.length - 1; i >= 0; i--) {
    const [x, y, z, w] = parts[i].orientation_xyzw;
    const turned = product(pose.rotation, [-x, -y, -z, w]);
    const position = subtract(pose.position, rotate(turned, parts[i].position_m));
    pose = { position, rotation: product(turned, [0, 0, Math.sin(-angles[i] / 2), Math.cos(angles[i] / 2)]) };
    frames.unshift(pose);
  }
  return frames;
}
