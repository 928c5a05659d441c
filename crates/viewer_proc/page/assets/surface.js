// Surfaces in pieces: one bone mesh per block of the volume, replaced when that bone was drilled, and one
// mesh per arm link.

const MAGIC = 0x48534d54;
const VERSION = 1;
const HEADER_BYTES = 36;
/** Triangles within this distance from a cut are drawn on both sides, so that a cut that trembles sorts none again. */
const CUT_MARGIN_M = 0.002;

/**
 * Decodes a `trabecula.mesh` message. @param {DataView} data
 * @returns {{block: number, vertices: number, indexCount: number, origin: number[], scale: number, positions: Uint16Array,
 *   normals: Int8Array, indices: Uint32Array}}
 */
export function decodeMesh(data) {
  const word = (at) => data.getUint32(at, true);
  if (word(0) !== MAGIC || word(4) !== VERSION) throw new Error("unsupported surface message format");
  const [block, vertices, indexCount] = [word(8), word(12), word(16)];
  const origin = [20, 24, 28].map((at) => data.getFloat32(at, true));
  const scale = data.getFloat32(32, true);
  // The bytes are copied because the payload is not aligned in the socket's buffer.
  const bytes = data.buffer.slice(data.byteOffset + HEADER_BYTES);
  const normalsAt = Math.ceil((vertices * 6) / 4) * 4;
  return {
    block, vertices, indexCount, origin, scale,
    positions: new Uint16Array(bytes, 0, vertices * 3),
    normals: new Int8Array(bytes, normalsAt, vertices * 4),
    indices: new Uint32Array(bytes, normalsAt + vertices * 4, indexCount),
  };
}

export class Surface {
  /** @param {WebGL2RenderingContext} gl @param {boolean} [merges] draws all blocks at once: in software, a call costs as
   * much as a thousand triangles */
  constructor(gl, merges = false) {
    this.gl = gl;
    this.merges = merges;
    /** All blocks in one, if they are merged and none has changed since. @type {object | undefined} */
    this.merged = undefined;
    /** @type {Map<number, object>} */
    this.blocks = new Map();
    this.triangles = 0;
    this.updates = 0;
  }

  clear() {
    for (const block of [...this.blocks.keys()]) this.#remove(block);
  }

  #remove(id) {
    const block = this.blocks.get(id);
    if (!block) return;
    this.triangles -= block.indexCount / 3;
    this.#free(block);
    this.blocks.delete(id);
    this.#free(this.merged);
    this.merged = undefined;
  }

  #free(drawn) {
    if (!drawn?.vertexArray) return;
    this.gl.deleteVertexArray(drawn.vertexArray);
    for (const buffer of drawn.buffers) this.gl.deleteBuffer(buffer);
  }

  /** Replaces a block's mesh; an empty one removes it. @param {DataView} data */
  update(data) {
    const { gl } = this;
    const mesh = decodeMesh(data);
    this.#remove(mesh.block);
    this.updates += 1;
    if (mesh.indexCount === 0) return;
    const { origin, scale, indexCount, positions, normals, indices } = mesh;
    // Positions and indices are kept for picking, and everything for merging.
    const kept = { origin, scale, indexCount, positions, indices, normals: this.merges ? normals : undefined };
    this.blocks.set(mesh.block, this.merges ? kept : { ...kept, ...this.#upload(positions, gl.UNSIGNED_SHORT, 6, normals, indices) });
    this.#free(this.merged);
    this.merged = undefined;
    this.triangles += indexCount / 3;
  }

  /** @param {Uint16Array | Float32Array} positions @param {number} type of a position @param {number} stride bytes per vertex */
  #upload(positions, type, stride, normals, indices) {
    const { gl } = this;
    const vertexArray = gl.createVertexArray();
    gl.bindVertexArray(vertexArray);
    const buffers = [positions, normals, indices].map((content, i) => {
      const buffer = gl.createBuffer();
      const target = i === 2 ? gl.ELEMENT_ARRAY_BUFFER : gl.ARRAY_BUFFER;
      gl.bindBuffer(target, buffer);
      gl.bufferData(target, content, gl.STATIC_DRAW);
      if (i === 0) gl.vertexAttribPointer(0, 3, type, false, stride, 0);
      if (i === 1) gl.vertexAttribPointer(1, 3, gl.BYTE, true, 4, 0);
      if (i < 2) gl.enableVertexAttribArray(i);
      return buffer;
    });
    return { vertexArray, buffers };
  }

  /** Copies all blocks into one, in metres. */
  #merge() {
    const all = [...this.blocks.values()];
    const vertices = all.reduce((sum, block) => sum + block.positions.length / 3, 0);
    const [positions, normals, indices] = [new Float32Array(3 * vertices), new Int8Array(4 * vertices), new Uint32Array(3 * this.triangles)];
    let [vertex, index] = [0, 0];
    for (const block of all) {
      normals.set(block.normals, 4 * vertex);
      for (let i = 0; i < block.positions.length; i++) positions[3 * vertex + i] = block.origin[i % 3] + block.scale * block.positions[i];
      for (let i = 0; i < block.indexCount; i++) indices[index + i] = vertex + block.indices[i];
      vertex += block.positions.length / 3;
      index += block.indexCount;
    }
    const farthest = Math.sqrt(3) * positions.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
    return { origin: [0, 0, 0], scale: 1, indexCount: index, positions, indices, farthest, ...this.#upload(positions, this.gl.FLOAT, 12, normals, indices) };
  }

  /** Sorts the triangles of the merged blocks: behind the cut, at it, in front of it. @param {number[]} cut */
  #sort(cut) {
    const { merged } = this;
    if (merged.cut && this.#isNear(cut)) return;
    const { positions, indices } = merged;
    const [x, y, z, w] = cut;
    const side = new Uint8Array(positions.length / 3);
    for (let vertex = 0, i = 0; i < positions.length; vertex++, i += 3) {
      const ahead = x * positions[i] + y * positions[i + 1] + z * positions[i + 2] + w;
      side[vertex] = ahead < -CUT_MARGIN_M ? 1 : ahead > CUT_MARGIN_M ? 2 : 4;
    }
    // From both ends; those at the cut go between them.
    const sorted = new Uint32Array(indices.length);
    let [behind, front] = [0, indices.length];
    const middle = [];
    for (let i = 0; i < indices.length; i += 3) {
      const sides = side[indices[i]] | side[indices[i + 1]] | side[indices[i + 2]];
      if (sides === 1) {
        for (let k = 0; k < 3; k++) sorted[behind++] = indices[i + k];
      } else if (sides === 2) {
        for (let k = 3; k > 0; k--) sorted[--front] = indices[i + k - 1];
      } else {
        middle.push(indices[i], indices[i + 1], indices[i + 2]);
      }
    }
    sorted.set(middle, behind);
    merged.indices = sorted;
    merged.cut = cut;
    merged.ends = [behind, front];
    this.gl.bindVertexArray(merged.vertexArray);
    this.gl.bufferData(this.gl.ELEMENT_ARRAY_BUFFER, sorted, this.gl.STATIC_DRAW);
  }

  /** Whether the merged triangles are still on the sides of a cut that they were sorted by. */
  #isNear(cut) {
    const [x, y, z, w] = cut.map((n, i) => n - this.merged.cut[i]);
    return Math.hypot(x, y, z) * this.merged.farthest + Math.abs(w) < CUT_MARGIN_M;
  }

  /**
   * Draws every block with the program in use.
   * @param {Record<string, WebGLUniformLocation>} uniforms @param {number} [side] +1: only what can lie behind the cut, -1: in front
   * @param {number[]} [cut] x, y, z, w of its plane
   */
  draw(uniforms, side = 0, cut = undefined) {
    const { gl, merges } = this;
    if (merges && this.blocks.size > 0) this.merged ??= this.#merge();
    for (const block of merges ? [this.merged] : this.blocks.values()) {
      if (!block) continue;
      let [first, end] = [0, block.indexCount];
      if (merges && cut) {
        this.#sort(cut);
        [first, end] = side > 0 ? [0, block.ends[1]] : [block.ends[0], end];
      }
      gl.uniform3fv(uniforms.u_origin, block.origin);
      gl.uniform1f(uniforms.u_scale, block.scale);
      gl.bindVertexArray(block.vertexArray);
      gl.drawElements(gl.TRIANGLES, end - first, gl.UNSIGNED_INT, 4 * first);
    }
  }
}
