// Picking: a point on the bone or the tool in the 3D view, or a point at the cross-hair's depth in the X-ray.

import { FIELD_OF_VIEW_RAD } from "/assets/camera.js";
import { add, cross, dot, length, scale, subtract, unit } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {{origin: Vector, direction: Vector}} Ray unit direction */

const LARGEST_INDEX = 65535;

/**
 * Returns the ray through a pixel of the 3D view. @param {import("/assets/camera.js").Camera} camera
 * @param {number} x @param {number} y @param {number} width @param {number} height pixels @returns {Ray}
 */
export function cameraRay(camera, x, y, width, height) {
  const { eye } = camera;
  const back = unit(subtract(eye, camera.centre));
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  const perPixel = (2 * Math.tan(FIELD_OF_VIEW_RAD / 2)) / height;
  const across = add(scale(right, (x - width / 2) * perPixel), scale(up, (height / 2 - y) * perPixel));
  return { origin: eye, direction: unit(subtract(across, back)) };
}

/** Returns the point of a ray nearest to a point. @param {Ray} ray @param {Vector} point */
export const nearest = (ray, point) => along(ray, Math.max(0, dot(subtract(point, ray.origin), ray.direction)));
/** @param {Ray} ray @param {number} distance */
const along = (ray, distance) => add(ray.origin, scale(ray.direction, distance));

/** Distance to a ball, or infinity. @param {Ray} ray @param {Vector} centre @param {number} radius */
function toBall(ray, centre, radius) {
  const away = subtract(centre, ray.origin);
  const ahead = dot(away, ray.direction);
  const beside = dot(away, away) - ahead * ahead;
  const left = radius * radius - beside;
  return left >= 0 && ahead > 0 ? ahead - Math.sqrt(left) : Infinity;
}

/** Whether a ray intersects a block's box. */
function meets({ origin, direction }, low, size) {
  let [near, far] = [0, Infinity];
  for (let axis = 0; axis < 3; axis++) {
    const [a, b] = [low[axis], low[axis] + size].map((side) => (side - origin[axis]) / (direction[axis] || 1e-12));
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far;
}

/**
 * Returns the distance to the nearest triangle of a block behind the cut (Möller and Trumbore, 1997), or
 * infinity.
 * @param {Ray} ray @param {{origin: number[], scale: number, positions: Uint16Array, indices: Uint32Array}} block
 * @param {number[]} cut x, y, z, w of the plane in front of which the bone is cut away; zeros: no cut
 */
function toBlock(ray, block, cut) {
  if (!meets(ray, block.origin, block.scale * LARGEST_INDEX)) return Infinity;
  const { positions, indices } = block;
  // In units of the block's steps.
  const start = ray.origin.map((x, axis) => (x - block.origin[axis]) / block.scale);
  const [dx, dy, dz] = ray.direction;
  let least = Infinity;
  for (let i = 0; i < indices.length; i += 3) {
    const [a, b, c] = [3 * indices[i], 3 * indices[i + 1], 3 * indices[i + 2]];
    const [ax, ay, az] = [positions[a], positions[a + 1], positions[a + 2]];
    const [ux, uy, uz] = [positions[b] - ax, positions[b + 1] - ay, positions[b + 2] - az];
    const [vx, vy, vz] = [positions[c] - ax, positions[c + 1] - ay, positions[c + 2] - az];
    const [px, py, pz] = [dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx];
    const determinant = ux * px + uy * py + uz * pz;
    if (determinant === 0) continue;
    const [tx, ty, tz] = [start[0] - ax, start[1] - ay, start[2] - az];
    const s = (tx * px + ty * py + tz * pz) / determinant;
    if (s < 0 || s > 1) continue;
    const [qx, qy, qz] = [ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux];
    const t = (dx * qx + dy * qy + dz * qz) / determinant;
    if (t < 0 || s + t > 1) continue;
    const distance = ((vx * qx + vy * qy + vz * qz) / determinant) * block.scale;
    if (distance <= 0 || distance >= least) continue;
    const point = along(ray, distance);
    if (cut[0] * point[0] + cut[1] * point[1] + cut[2] * point[2] + cut[3] > 0) continue;
    least = distance;
  }
  return least;
}

/**
 * Returns the nearest point of bone or burr on a ray, or undefined.
 * @param {Ray} ray @param {Iterable<any>} blocks @param {number[]} cut @param {{centre: Vector, radius: number}[]} balls
 */
export function pick(ray, blocks, cut, balls) {
  let least = Math.min(Infinity, ...balls.map(({ centre, radius }) => toBall(ray, centre, radius)));
  for (const block of blocks) least = Math.min(least, toBlock(ray, block, cut));
  return Number.isFinite(least) ? along(ray, least) : undefined;
}

/** @typedef {{intrinsics: number[], rotation: number[], translation: number[]}} Projection of a frame: K, R and t, row-major */

/** Projects a point into a frame: column, row (pixel centres are integers) and depth in metres; undefined behind the source. @param {Projection} p @param {Vector} point */
export function project({ intrinsics: k, rotation: r, translation: t }, point) {
  const camera = [0, 1, 2].map((row) => r[3 * row] * point[0] + r[3 * row + 1] * point[1] + r[3 * row + 2] * point[2] + t[row]);
  if (!(camera[2] > 0)) return undefined;
  const row = (i) => (k[3 * i] * camera[0] + k[3 * i + 1] * camera[1] + k[3 * i + 2] * camera[2]) / camera[2];
  return [row(0), row(1), camera[2]];
}

/** Returns the point at a depth, column and row. @param {Projection} p @param {number} column @param {number} row @param {number} depth metres @returns {Vector} */
export function unproject({ intrinsics: k, rotation: r, translation: t }, column, row, depth) {
  const y = (row - k[5]) / k[4];
  const x = (column - k[2] - k[1] * y) / k[0];
  const off = [x * depth - t[0], y * depth - t[1], depth - t[2]];
  const world = (axis) => r[axis] * off[0] + r[3 + axis] * off[1] + r[6 + axis] * off[2];
  return [world(0), world(1), world(2)];
}

/** Returns the position of the X-ray source. @param {Projection} p @returns {Vector} */
export function sourceOf({ rotation: r, translation: t }) {
  const world = (axis) => -(r[axis] * t[0] + r[3 + axis] * t[1] + r[6 + axis] * t[2]);
  return [world(0), world(1), world(2)];
}

/** Returns pixels per millimetre at a depth, for sizes. @param {Projection} p @param {number} depth */
export const pixelsPerMetre = ({ intrinsics: k }, depth) => length([k[0], 0, 0]) / depth;
