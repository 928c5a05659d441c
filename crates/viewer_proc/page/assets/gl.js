// WebGL2: programs, and buffers for shapes and instances.

import { INSTANCE_FLOATS } from "/assets/parts_list.js";

/** Links a program and looks up its uniforms. @param {WebGL2RenderingContext} gl */
export function program(gl, vertexSource, fragmentSource) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(linked));
  /** @type {Record<string, WebGLUniformLocation>} */
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(linked, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(linked, i);
    uniforms[name] = gl.getUniformLocation(linked, name);
  }
  return { linked, uniforms };
}

function filled(gl, target, data) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(target, buffer);
  gl.bufferData(target, data, gl.STATIC_DRAW);
  return buffer;
}

/** A unit shape with instanced drawing. */
export class InstancedShape {
  /** @param {WebGL2RenderingContext} gl @param {import("/assets/shapes.js").Shape} shape */
  constructor(gl, shape) {
    this.gl = gl;
    this.indexCount = shape.indices.length;
    this.vertexArray = gl.createVertexArray();
    gl.bindVertexArray(this.vertexArray);
    for (const { location, data } of [{ location: 0, data: shape.positions }, { location: 1, data: shape.normals }]) {
      filled(gl, gl.ARRAY_BUFFER, new Float32Array(data));
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 0, 0);
    }
    filled(gl, gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(shape.indices));
    this.instances = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    let offset = 0;
    for (const [location, size] of [[2, 3], [3, 4], [4, 3], [5, 4]]) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, gl.FLOAT, false, INSTANCE_FLOATS * 4, offset);
      gl.vertexAttribDivisor(location, 1);
      offset += size * 4;
    }
  }

  /** @param {number[]} numbers `INSTANCE_FLOATS` per instance */
  draw(numbers) {
    if (numbers.length === 0) return;
    const { gl } = this;
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(numbers), gl.STREAM_DRAW);
    gl.drawElementsInstanced(gl.TRIANGLES, this.indexCount, gl.UNSIGNED_SHORT, 0, numbers.length / INSTANCE_FLOATS);
  }
}
