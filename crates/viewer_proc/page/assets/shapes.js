// Unit shapes as triangles: positions, normals, indices.

/** @typedef {{positions: number[], normals: number[], indices: number[]}} Shape */

/** Corners around a shape and around the parts of a thin line, which is a few pixels wide. `LIGHT`: for moving pictures
 * that are rendered in software. */
export const FINE = { around: 24, thin: 8 };
export const LIGHT = { around: 12, thin: 6 };

/** A ring of points between two radii along z; `slope` is the normal's z. */
function ring(shape, around, radiusLow, radiusHigh, zLow, zHigh, slope) {
  const start = shape.positions.length / 3;
  for (let i = 0; i <= around; i++) {
    const angle = (2 * Math.PI * i) / around;
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    shape.positions.push(radiusLow * c, radiusLow * s, zLow, radiusHigh * c, radiusHigh * s, zHigh);
    shape.normals.push(c, s, slope, c, s, slope);
    const at = start + 2 * i;
    if (i < around) shape.indices.push(at, at + 2, at + 1, at + 1, at + 2, at + 3);
  }
}

/** A disc perpendicular to z. @param {number} up +1 or -1: direction of its normal */
function disc(shape, around, z, up) {
  const start = shape.positions.length / 3;
  shape.positions.push(0, 0, z);
  shape.normals.push(0, 0, up);
  for (let i = 0; i <= around; i++) {
    const angle = (up * 2 * Math.PI * i) / around;
    shape.positions.push(Math.cos(angle), Math.sin(angle), z);
    shape.normals.push(0, 0, up);
    if (i < around) shape.indices.push(start, start + 1 + i, start + 2 + i);
  }
}

const empty = () => ({ positions: [], normals: [], indices: [] });

/** Radius 1, from z = 0 to z = 1, closed. @param {number} around @returns {Shape} */
export function cylinder(around) {
  const shape = empty();
  ring(shape, around, 1, 1, 0, 1, 0);
  disc(shape, around, 0, -1);
  disc(shape, around, 1, 1);
  return shape;
}

/** Radius 1 at z = 0, a point at z = 1. @param {number} around @returns {Shape} */
export function cone(around) {
  const shape = empty();
  ring(shape, around, 1, 0, 0, 1, 1);
  disc(shape, around, 0, -1);
  return shape;
}

/** Radius 1 about the origin. @param {number} around even @returns {Shape} */
export function sphere(around) {
  const shape = empty();
  const rows = around / 2;
  for (let row = 0; row <= rows; row++) {
    const polar = (Math.PI * row) / rows;
    for (let i = 0; i <= around; i++) {
      const angle = (2 * Math.PI * i) / around;
      const point = [Math.sin(polar) * Math.cos(angle), Math.sin(polar) * Math.sin(angle), Math.cos(polar)];
      shape.positions.push(...point);
      shape.normals.push(...point);
      if (row === rows || i === around) continue;
      const at = row * (around + 1) + i;
      shape.indices.push(at, at + around + 1, at + 1, at + 1, at + around + 1, at + around + 2);
    }
  }
  return shape;
}

/** Half extents 1 about the origin. @returns {Shape} */
export function cube() {
  const shape = empty();
  for (let axis = 0; axis < 3; axis++) {
    for (const side of [-1, 1]) {
      const start = shape.positions.length / 3;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const point = [0, 0, 0];
        const normal = [0, 0, 0];
        [point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3]] = [side, u, v];
        normal[axis] = side;
        shape.positions.push(...point);
        shape.normals.push(...normal);
      }
      const order = side > 0 ? [0, 1, 2, 0, 2, 3] : [0, 2, 1, 0, 3, 2];
      shape.indices.push(...order.map((k) => start + k));
    }
  }
  return shape;
}

/** Every shape of a parts list. @param {{around: number, thin: number}} corners */
export const shapes = ({ around, thin }) => ({
  cylinder: cylinder(around), cone: cone(around), sphere: sphere(around), cube: cube(), rod: cylinder(thin), bead: sphere(thin),
});
