// Instances of unit shapes for tool, paths and arrows.

import { add, cross, dot, length, scale, subtract, unit } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {import("/assets/vector.js").Quaternion} Quaternion */
/** @typedef {import("/assets/vector.js").Pose} Pose */
/** @typedef {[number, number, number, number]} Colour red, green, blue, opacity: 0 to 1 */

/** Numbers per instance: position 3, rotation 4, scale 3, colour 4. */
export const INSTANCE_FLOATS = 14;

/** Cosine of the largest turn of a thin line, 15 degrees, whose corner needs no bead to close. */
const STRAIGHT = 0.966;

/** Returns the rotation from +z to a direction. @param {Vector} direction a unit vector @returns {Quaternion} */
function fromZ(direction) {
  const w = 1 + direction[2];
  if (w < 1e-6) return [1, 0, 0, 0];
  const axis = cross([0, 0, 1], direction);
  const n = Math.hypot(...axis, w);
  return [axis[0] / n, axis[1] / n, axis[2] / n, w / n];
}

/** Whether a line passes through a point almost straight. @param {Vector[]} points @param {number} i */
function isStraightAt(points, i) {
  if (i === 0 || i === points.length - 1) return false;
  const [before, after] = [subtract(points[i], points[i - 1]), subtract(points[i + 1], points[i])];
  return dot(before, after) > STRAIGHT * length(before) * length(after);
}

/** Instances by shape. */
export class PartsList {
  constructor() {
    /** `rod` and `bead`: cylinders and spheres of thin lines. @type {Record<"cylinder" | "cone" | "sphere" | "cube" | "rod" | "bead", number[]>} */
    this.shapes = { cylinder: [], cone: [], sphere: [], cube: [], rod: [], bead: [] };
  }

  /** @param {Vector} centre @param {number} radius metres @param {Colour} colour */
  sphere(centre, radius, colour) {
    this.shapes.sphere.push(...centre, 0, 0, 0, 1, radius, radius, radius, ...colour);
  }

  /** A closed cylinder between two points. @param {Vector} from @param {Vector} to @param {number} radius @param {Colour} colour */
  cylinder(from, to, radius, colour, shape = this.shapes.cylinder) {
    const along = subtract(to, from);
    const span = length(along);
    if (span < 1e-9) return;
    shape.push(...from, ...fromZ(unit(along)), radius, radius, span, ...colour);
  }

  /** A cylinder with rounded ends. @param {Vector} from @param {Vector} to @param {number} radius @param {Colour} colour */
  capsule(from, to, radius, colour) {
    this.cylinder(from, to, radius, colour);
    this.sphere(from, radius, colour);
    this.sphere(to, radius, colour);
  }

  #bead(centre, radius, colour) {
    this.shapes.bead.push(...centre, 0, 0, 0, 1, radius, radius, radius, ...colour);
  }

  /** @param {Pose} pose @param {Vector} halfExtents @param {Colour} colour */
  cuboid(pose, halfExtents, colour) {
    this.shapes.cube.push(...pose.position, ...pose.rotation, ...halfExtents, ...colour);
  }

  /** @param {Vector} from @param {Vector} along with its length @param {number} radius of the stem @param {Colour} colour */
  arrow(from, along, radius, colour) {
    const span = length(along);
    if (span < 1e-5) return;
    const head = Math.min(span * 0.5, radius * 5);
    const neck = add(from, scale(along, 1 - head / span));
    this.cylinder(from, neck, radius, colour);
    this.shapes.cone.push(...neck, ...fromZ(unit(along)), radius * 2.4, radius * 2.4, head, ...colour);
  }

  /** A thin polyline with rounded corners and ends; `dash` draws every other piece of that length, measured along the whole
   * line. */
  path(points, radius, colour, dash = 0) {
    if (dash === 0) points.forEach((point, i) => !isStraightAt(points, i) && this.#bead(point, radius, colour));
    let passed = 0;
    for (let i = 1; i < points.length; i++) {
      if (dash === 0) {
        this.cylinder(points[i - 1], points[i], radius, colour, this.shapes.rod);
        continue;
      }
      const along = subtract(points[i], points[i - 1]);
      const span = length(along);
      const at = (way) => add(points[i - 1], scale(along, (way - passed) / (span || 1)));
      const end = passed + span;
      for (let k = 2 * Math.floor(passed / (2 * dash)); k * dash < end; k += 2) {
        const [from, to] = [Math.max(passed, k * dash), Math.min(end, (k + 1) * dash)];
        if (to > from) this.cylinder(at(from), at(to), radius, colour, this.shapes.rod);
      }
      passed = end;
    }
  }

  /** Three crossed bars and a ball: a marker recognizable by its shape. @param {Vector} centre @param {number} size @param {Colour} colour */
  target(centre, size, colour) {
    this.sphere(centre, size * 0.35, colour);
    for (let axis = 0; axis < 3; axis++) {
      /** @type {Vector} */
      const bar = [0, 0, 0];
      bar[axis] = size;
      this.cylinder(subtract(centre, bar), add(centre, bar), size * 0.08, colour);
    }
  }
}

/** The plane through a point with its normal toward the eye: x, y, z, w of n·p + w. */
export function planeTowards(point, normal, eye) {
  const facing = dot(normal, subtract(eye, point)) < 0 ? scale(normal, -1) : normal;
  return [...facing, -dot(facing, point)];
}

