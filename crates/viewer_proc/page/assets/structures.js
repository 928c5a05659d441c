// Critical structures: their meshes, colours, and outlines in a projection.

import { toolColour } from "/assets/clearance.js";
import { decodeMesh } from "/assets/surface.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {import("/assets/parts_list.js").Colour} Colour */
/**
 * @typedef {object} Mesh
 * @property {Float64Array} corners x, y, z of each, metres
 * @property {Uint32Array} indices three per triangle
 * @property {Uint32Array} edges four numbers each: two corners, and the two triangles that share them
 */

const STEPS = 65536;
/** Hues of structures to avoid and of targets: the first, and the range. */
const AVOID_HUES = [75, 195];
const TARGET_HUES = [300, 40];
/** Neighbours in the list differ most: the golden section. */
const HUE_STEP = 0.618;

/** @param {number} hue degrees @returns {Colour} */
function saturated(hue) {
  const part = (n) => {
    const k = (n + hue / 30) % 12;
    return 0.56 - 0.31 * Math.max(-1, Math.min(k - 3, 9 - k, 1));
  };
  return [part(0), part(8), part(4), 1];
}

/** Returns the edges of a mesh; corners at the same place are one. @param {Uint16Array} positions @param {Uint32Array} indices */
function edgesOf(positions, indices) {
  const places = new Map();
  const corner = Uint32Array.from({ length: positions.length / 3 }, (_, i) => {
    const place = (positions[3 * i] * STEPS + positions[3 * i + 1]) * STEPS + positions[3 * i + 2];
    if (!places.has(place)) places.set(place, i);
    return places.get(place);
  });
  const open = new Map();
  /** @type {number[]} */
  const edges = [];
  for (let i = 0; i < indices.length; i++) {
    const [a, b] = [corner[indices[i]], corner[indices[i % 3 === 2 ? i - 2 : i + 1]]];
    const key = Math.min(a, b) * 2 ** 26 + Math.max(a, b);
    const triangle = Math.floor(i / 3);
    const other = open.get(key);
    if (other === undefined) {
      open.set(key, triangle);
    } else {
      edges.push(a, b, other, triangle);
      open.delete(key);
    }
  }
  return Uint32Array.from(edges);
}

/**
 * Returns the edges of a mesh's outline seen from a point: those between a triangle that faces it and one
 * that does not. @param {Mesh} mesh @param {Vector} eye @returns {[Vector, Vector][]}
 */
export function outlineFrom({ corners, indices, edges }, [x, y, z]) {
  const faces = new Uint8Array(indices.length / 3);
  for (let i = 0; i < faces.length; i++) {
    const [a, b, c] = [3 * indices[3 * i], 3 * indices[3 * i + 1], 3 * indices[3 * i + 2]];
    const [ax, ay, az] = [corners[a], corners[a + 1], corners[a + 2]];
    const [ux, uy, uz] = [corners[b] - ax, corners[b + 1] - ay, corners[b + 2] - az];
    const [vx, vy, vz] = [corners[c] - ax, corners[c + 1] - ay, corners[c + 2] - az];
    const toEye = (uy * vz - uz * vy) * (x - ax) + (uz * vx - ux * vz) * (y - ay) + (ux * vy - uy * vx) * (z - az);
    faces[i] = toEye > 0 ? 1 : 0;
  }
  /** @param {number} i @returns {Vector} */
  const corner = (i) => [corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]];
  /** @type {[Vector, Vector][]} */
  const outline = [];
  for (let i = 0; i < edges.length; i += 4) {
    if (faces[edges[i + 2]] !== faces[edges[i + 3]]) outline.push([corner(edges[i]), corner(edges[i + 1])]);
  }
  return outline;
}

export class Structures {
  /** @param {import("/assets/model.js").Model} model @param {() => void} changed */
  constructor(model, changed) {
    this.model = model;
    this.changed = changed;
    this.on = true;
    /** By the index in the scene. @type {Map<number, Mesh>} */
    this.meshes = new Map();
    /** Incremented when a mesh comes or goes. */
    this.version = 0;
  }

  /** Takes a `trabecula.mesh` message. @param {DataView} data */
  take(data) {
    const { block, origin, scale, positions, indices } = decodeMesh(data);
    const corners = Float64Array.from(positions, (step, i) => origin[i % 3] + scale * step);
    this.meshes.set(block, { corners, indices, edges: edgesOf(positions, indices) });
    this.version += 1;
    this.changed();
  }

  clear() {
    this.meshes.clear();
    this.version += 1;
  }

  toggle() {
    this.on = !this.on;
    this.version += 1;
    this.changed();
  }

  /** The structures with a mesh, in colours of their own. @returns {{index: number, name: string, colour: Colour, mesh: Mesh}[]} */
  get all() {
    return (this.model.info?.scene?.structures ?? []).flatMap(({ name, is_target }, index) => {
      const mesh = this.meshes.get(index);
      const [first, range] = is_target ? TARGET_HUES : AVOID_HUES;
      return mesh ? [{ index, name, mesh, colour: saturated(first + ((index * HUE_STEP) % 1) * range) }] : [];
    });
  }

  /** Those to draw: one within whose margin the tool is has the tool's colour. */
  get shown() {
    if (!this.on) return [];
    const { clearances } = this.model;
    return this.all.map((structure) => ({ ...structure, colour: toolColour([clearances[structure.index]]) ?? structure.colour }));
  }
}
