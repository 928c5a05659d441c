// Intersections of a plane with cylinders and balls of the tool, and with meshes.

import { add, cross, dot, length, scale, subtract, unit } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {[number, number]} Point to the right and down, metres */
/** @typedef {{centre: Vector, right: Vector, down: Vector}} Plane unit vectors to the right and down the picture */

const AROUND = 24;

/** Normal, pointing away from the viewer. @param {Plane} plane */
export const normal = (plane) => cross(plane.right, plane.down);

/** Coordinates to the right, down and behind the plane, metres. @param {Plane} plane @param {Vector} point @returns {Vector} */
export function place(plane, point) {
  const away = subtract(point, plane.centre);
  return [dot(away, plane.right), dot(away, plane.down), dot(away, normal(plane))];
}

/** @param {Plane} plane @param {Point} at @returns {Vector} */
export const pointAt = (plane, [right, down]) => add(plane.centre, add(scale(plane.right, right), scale(plane.down, down)));

/** Returns the convex hull of points, in order. @param {Point[]} points @returns {Point[]} */
function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (list) => {
    /** @type {Point[]} */
    const chain = [];
    for (const point of list) {
      const turn = ([ax, ay], [bx, by]) => (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax);
      while (chain.length > 1 && turn(chain.at(-2), chain.at(-1)) <= 0) chain.pop();
      chain.push(point);
    }
    chain.pop();
    return chain;
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

/**
 * Returns the section of a closed cylinder: the hull of the points where the plane crosses the edges of an
 * inscribed prism.
 * @param {Plane} plane @param {Vector} from @param {Vector} to @param {number} radius metres @returns {Point[]} empty: nothing
 */
export function cutCylinder(plane, from, to, radius) {
  const along = subtract(to, from);
  if (length(along) < 1e-9) return [];
  const axis = unit(along);
  const side = unit(cross(axis, Math.abs(axis[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const other = cross(axis, side);
  const ring = Array.from({ length: AROUND }, (_, i) => {
    const angle = (2 * Math.PI * i) / AROUND;
    return add(scale(side, radius * Math.cos(angle)), scale(other, radius * Math.sin(angle)));
  });
  const low = ring.map((offset) => place(plane, add(from, offset)));
  const high = ring.map((offset) => place(plane, add(to, offset)));
  /** @type {Point[]} */
  const points = [];
  /** @param {Vector} a @param {Vector} b */
  const edge = (a, b) => {
    if (a[2] > 0 === b[2] > 0) return;
    const share = a[2] / (a[2] - b[2]);
    points.push([a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]);
  };
  for (let i = 0; i < AROUND; i++) {
    const next = (i + 1) % AROUND;
    edge(low[i], high[i]);
    edge(low[i], low[next]);
    edge(high[i], high[next]);
  }
  return points.length > 2 ? hull(points) : [];
}

/** @param {Plane} plane @param {Vector} centre @param {number} radius @returns {{at: Point, radius: number} | undefined} */
export function cutBall(plane, centre, radius) {
  const [right, down, behind] = place(plane, centre);
  const left = radius * radius - behind * behind;
  return left > 0 ? { at: [right, down], radius: Math.sqrt(left) } : undefined;
}

/**
 * Returns where a plane cuts a closed mesh: two ends of a segment for each triangle, to the right and down.
 * @param {Plane} plane @param {import("/assets/structures.js").Mesh} mesh @returns {[Point, Point][]}
 */
export function cutMesh(plane, { corners, indices }) {
  const [x, y, z] = normal(plane);
  const at = dot(plane.centre, [x, y, z]);
  const behind = new Float64Array(corners.length / 3);
  for (let i = 0; i < behind.length; i++) behind[i] = x * corners[3 * i] + y * corners[3 * i + 1] + z * corners[3 * i + 2] - at;
  /** @param {number} i @param {Vector} axis */
  const along = (i, axis) => dot([corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]], axis) - dot(plane.centre, axis);
  /** @param {number} a @param {number} b @returns {Point} */
  const crossing = (a, b) => {
    const share = behind[a] / (behind[a] - behind[b]);
    const [right, down] = [plane.right, plane.down].map((axis) => along(a, axis) + share * (along(b, axis) - along(a, axis)));
    return [right, down];
  };
  /** @type {[Point, Point][]} */
  const segments = [];
  for (let i = 0; i < indices.length; i += 3) {
    const [a, b, c] = [indices[i], indices[i + 1], indices[i + 2]];
    const [isA, isB, isC] = [behind[a] > 0, behind[b] > 0, behind[c] > 0];
    if (isA === isB && isB === isC) continue;
    // One corner is on its own side.
    const [alone, other, third] = isB === isC ? [a, b, c] : isA === isC ? [b, c, a] : [c, a, b];
    segments.push([crossing(alone, other), crossing(alone, third)]);
  }
  return segments;
}
