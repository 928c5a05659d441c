// Vectors, quaternions (x y z w) and column-major 4×4 matrices, as plain arrays.

/** @typedef {[number, number, number]} Vector */
/** @typedef {[number, number, number, number]} Quaternion */
/** @typedef {{position: Vector, rotation: Quaternion}} Pose  T_parent_child; metres. */

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @param {Vector} a @param {Vector} b @returns {Vector} */
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @param {Vector} a @param {number} s @returns {Vector} */
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
/** @param {Vector} a @param {Vector} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {Vector} a @param {Vector} b @returns {Vector} */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @param {Vector} a */
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
/** Normalises a vector; zero stays zero. @param {Vector} a @returns {Vector} */
export const unit = (a) => scale(a, 1 / (length(a) || 1));

/** @param {Quaternion} q @param {Vector} v @returns {Vector} */
export function rotate(q, v) {
  const [x, y, z, w] = q;
  const t = scale(cross([x, y, z], v), 2);
  return add(add(v, scale(t, w)), cross([x, y, z], t));
}

/** Applies b, then a. @param {Quaternion} a @param {Quaternion} b @returns {Quaternion} */
export function product([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
  ];
}

/** Transforms a point from the child frame to the parent frame. @param {Pose} pose @param {Vector} point */
export const transform = (pose, point) => add(pose.position, rotate(pose.rotation, point));

/** Perspective projection onto OpenGL's clip cube -1..1. @param {number} fovRad vertical angle */
export function perspective(fovRad, aspect, near, far) {
  const f = 1 / Math.tan(fovRad / 2);
  const d = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
}

/** World-to-camera matrix for a camera at `eye` looking at `centre`. @param {Vector} eye @param {Vector} centre @param {Vector} up */
export function lookAt(eye, centre, up) {
  const back = unit(subtract(eye, centre));
  const right = unit(cross(up, back));
  const above = cross(back, right);
  return [
    right[0], above[0], back[0], 0, right[1], above[1], back[1], 0, right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ];
}

/** The product a b. @param {number[]} a @param {number[]} b @returns {number[]} */
export function multiply(a, b) {
  const out = new Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[k * 4 + row] * b[column * 4 + k];
      out[column * 4 + row] = sum;
    }
  }
  return out;
}

/** Clip-space x, y, z, w of a point. @param {number[]} m @param {Vector} p */
export function project(m, p) {
  const row = (i) => m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i];
  return [row(0), row(1), row(2), row(3)];
}
