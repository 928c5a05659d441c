// Arm, shaft, links, burr, bodies, paths and contact forces as a list of parts.

import { planeTowards } from "/assets/parts_list.js";
import { add, length, rotate, scale, subtract, transform } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Pose} Pose */
/** @typedef {import("/assets/parts_list.js").PartsList} PartsList */

/** Radii of the drawn arm, from its base: thinner than the robot, so that it hides little. */
const ARM_RADII_M = [0.03, 0.028, 0.025, 0.02, 0.018, 0.016];
/** Length of a force arrow. */
export const ARROW_M_PER_N = 0.002;
const TRAIL_STEP_M = 0.0003;
const TRAIL_POINTS = 4000;
const LEAP_M = 0.005;

/** @type {Record<string, import("/assets/parts_list.js").Colour>} */
export const COLOURS = {
  arm: [0.5, 0.51, 0.53, 0.4], shaft: [0.66, 0.67, 0.7, 1], holder: [0.46, 0.47, 0.5, 1], outerTube: [0.58, 0.6, 0.64, 1], linkEven: [0.16, 0.55, 0.78, 1], linkOdd: [0.52, 0.8, 0.93, 1],
  burr: [0.96, 0.45, 0.08, 1], cursor: [0.2, 0.72, 0.45, 1], measure: [0.9, 0.75, 0.05, 1], target: [0.85, 0.15, 0.65, 1], planned: [0.1, 0.62, 0.33, 1], drilled: [0.95, 0.75, 0.1, 1],
  force: [0.86, 0.1, 0.16, 1], body: [0.55, 0.5, 0.75, 1], second: [0.45, 0.4, 0.95, 0.45],
  margin: [1, 0.8, 0.2, 1], breach: [0.8, 0.05, 0.2, 1],
};

/** @typedef {{arm: Pose[], flange: Pose, base: Pose, links: Pose[], burr: Pose}} Poses */

/** The path of the burr. */
export class Trail {
  /** @type {{point: import("/assets/vector.js").Vector, time: number}[]} */
  steps = [];

  get points() {
    return this.steps.map((step) => step.point);
  }

  /** Adds a point. If time goes backward, later points are dropped; after a jump (a reset, a scrub) the
   * path restarts. */
  add(point, time) {
    while (this.steps.length > 0 && this.steps.at(-1).time >= time) this.steps.pop();
    const gone = this.steps.length > 0 ? length(subtract(point, this.steps.at(-1).point)) : Infinity;
    if (gone < TRAIL_STEP_M) return;
    if (gone > LEAP_M) this.clear();
    this.steps.push({ point, time });
    if (this.steps.length > TRAIL_POINTS) this.steps = this.steps.filter((_, i) => i % 2 === 0);
  }

  clear() {
    this.steps = [];
  }
}

/** @param {PartsList} list @param {Poses} poses @param {object} tool of `/view/info` @param {object} [one] one colour for all */
export function addTool(list, poses, tool, one) {
  const shaft = tool.shaft ?? { length_m: 0, radius_m: 0.003 };
  const end = poses.links[0]?.position ?? transform(poses.base, [0, 0, shaft.length_m]);
  list.cylinder(poses.base.position, end, shaft.radius_m, one ?? COLOURS.shaft);
  const front = holderFront(poses, tool);
  if (tool.outer_tube) {
    const { length_m, radius_m } = tool.outer_tube;
    list.cylinder(front ?? poses.base.position, transform(poses.base, [0, 0, length_m]), radius_m, one ?? COLOURS.outerTube);
  }
  if (front) {
    list.cylinder(poses.flange.position, front, tool.holder.radius_m, one ?? COLOURS.holder);
    list.cylinder(front, poses.base.position, shaft.radius_m, one ?? COLOURS.shaft);
    list.sphere(poses.base.position, shaft.radius_m, one ?? COLOURS.shaft);
  }
  poses.links.forEach((pose, i) => {
    const link = tool.links?.[i] ?? { length_m: 0.001, outer_radius_m: 0.003 };
    const colour = one ?? (i % 2 === 0 ? COLOURS.linkEven : COLOURS.linkOdd);
    list.cylinder(pose.position, transform(pose, [0, 0, link.length_m]), link.outer_radius_m, colour);
    // A ball in each joint, because a bend would open a gap between two cylinders.
    list.sphere(pose.position, link.outer_radius_m, colour);
  });
  for (const { centre, radius } of burrBalls(poses, tool)) list.sphere(centre, radius, one ?? COLOURS.burr);
}

/** The balls of the burr, from front to back. @param {Poses} poses @param {any} [tool] of `/view/info` */
export function burrBalls(poses, tool) {
  const balls = tool?.burr_balls ?? [{ behind_m: 0, radius_m: 0.003 }];
  return balls.map((ball) => ({ centre: transform(poses.burr, [0, 0, -ball.behind_m]), radius: ball.radius_m }));
}

/**
 * Adds the arm as tubes between its frames, except for links that have a mesh: link i ends at frame i.
 * @param {PartsList} list @param {Poses} poses @param {{has: (link: number) => boolean}} meshed
 */
export function addArm(list, poses, meshed) {
  const points = [...poses.arm.map((pose) => pose.position), poses.flange.position];
  for (let i = 1; i < points.length; i++) {
    if (meshed.has(i)) continue;
    list.capsule(points[i - 1], points[i], ARM_RADII_M[Math.min(i - 1, ARM_RADII_M.length - 1)], COLOURS.arm);
  }
}

/** Returns the point where the holder on the flange ends and the bare shaft begins; undefined if the tool's base is on the flange. @param {Poses} poses @param {any} tool of `/view/info` */
export function holderFront(poses, tool) {
  if (!tool.holder) return undefined;
  const way = subtract(poses.base.position, poses.flange.position);
  return add(poses.flange.position, scale(way, tool.holder.length_m / length(way)));
}

/** @param {PartsList} list @param {{point: import("/assets/vector.js").Vector, force: import("/assets/vector.js").Vector}[]} contacts force on the tool in newtons */
export function addContacts(list, contacts) {
  for (const { point, force } of contacts) {
    list.arrow(point, scale(force, ARROW_M_PER_N), 0.0003, COLOURS.force);
  }
}

/** @param {PartsList} list @param {object[]} bodies of `/view/info` @param {Pose[]} poses */
export function addBodies(list, bodies, poses) {
  bodies.forEach((body, i) => {
    const pose = poses[i];
    if (!pose) return;
    const half = body.half_height_m ?? 0;
    if (body.shape === "cuboid") list.cuboid(pose, body.half_extents_m, COLOURS.body);
    else if (body.shape === "ball") list.sphere(pose.position, body.radius_m, COLOURS.body);
    else list.capsule(transform(pose, [0, 0, -half]), transform(pose, [0, 0, half]), body.radius_m, COLOURS.body);
  });
}

/** Returns the plane in which the tool bends, through its base, facing the eye. @param {Pose} base @param {number[]} eye */
export function bendingPlane(base, eye) {
  return planeTowards(base.position, rotate(base.rotation, [0, 1, 0]), eye);
}

/** Returns the contacts of a state: point, and sum of normal and friction force. @param {Record<string, Function>} read @param {DataView} state */
export function contactsOf(read, state) {
  return Array.from({ length: read.contactCount(state) }, (_, i) => {
    const at = read.contacts[i];
    const point = at.point.map((f) => f(state));
    const normal = scale(at.normal.map((f) => f(state)), at.normalForce(state));
    return { point, force: add(normal, at.friction.map((f) => f(state))) };
  });
}
