// Surfaces in pieces: one bone mesh per block of the volume, replaced when that bone was drilled, and one
// mesh per arm link.

const MAGIC = 0x48534d54;
const VERSION = 1;
const HEADER_BYTES = 36;

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
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
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
    this.gl.deleteVertexArray(block.vertexArray);
    for (const buffer of block.buffers) this.gl.deleteBuffer(buffer);
    this.blocks.delete(id);
  }

  /** Replaces a block's mesh; an empty one removes it. @param {DataView} data */
  update(data) {
    const { gl } = this;
    const mesh = decodeMesh(data);
    this.#remove(mesh.block);
    this.updates += 1;
    if (mesh.indexCount === 0) return;
    const vertexArray = gl.createVertexArray();
    gl.bindVertexArray(vertexArray);
    const buffers = [mesh.positions, mesh.normals, mesh.indices].map((content, i) => {
      const buffer = gl.createBuffer();
      const target = i === 2 ? gl.ELEMENT_ARRAY_BUFFER : gl.ARRAY_BUFFER;
      gl.bindBuffer(target, buffer);
      gl.bufferData(target, content, gl.STATIC_DRAW);
      if (i === 0) gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 6, 0);
      if (i === 1) gl.vertexAttribPointer(1, 3, gl.BYTE, true, 4, 0);
      if (i < 2) gl.enableVertexAttribArray(i);
      return buffer;
    });
    const { origin, scale, indexCount, positions, indices } = mesh;
    // Positions and indices are kept for picking.
    this.blocks.set(mesh.block, { vertexArray, buffers, origin, scale, indexCount, positions, indices });
    this.triangles += indexCount / 3;
  }

  /** Draws every block with the program in use. @param {Record<string, WebGLUniformLocation>} uniforms */
  draw(uniforms) {
    for (const block of this.blocks.values()) {
      this.gl.uniform3fv(uniforms.u_origin, block.origin);
      this.gl.uniform1f(uniforms.u_scale, block.scale);
      this.gl.bindVertexArray(block.vertexArray);
      this.gl.drawElements(this.gl.TRIANGLES, block.indexCount, this.gl.UNSIGNED_INT, 0);
    }
  }
}
