// The 3D view: bone, tool, paths and forces, drawn with WebGL2 on change.

import { Camera } from "/assets/camera.js";
import { toolColour } from "/assets/clearance.js";
import { Detail } from "/assets/detail.js";
import { InstancedShape, program } from "/assets/gl.js";
import { PartsList } from "/assets/parts_list.js";
import { addFrustum, addPlannedTool } from "/assets/plan_view.js";
import { cameraRay, nearest, pick } from "/assets/pick.js";
import { PART_FRAGMENT, PART_VERTEX, SURFACE_FRAGMENT, SURFACE_VERTEX } from "/assets/shaders.js";
import { FINE, LIGHT, shapes } from "/assets/shapes.js";
import { SOFTWARE } from "/assets/software.js";
import { Surface } from "/assets/surface.js";
import { COLOURS, addArm, addBodies, addContacts, addTool, bendingPlane, burrBalls } from "/assets/tool_model.js";
import { transform } from "/assets/vector.js";

/** Display modes of the bone. */
export const BONE_MODES = ["section", "glass", "solid", "hidden"];
/** A view rendered in software has every pixel and finer shapes once it has been still for this long. */
const STILL_MS = 250;
/** Within this distance from the line of sight to the tool, the arm is faded. */
const FADE_M = 0.03;
const STRUCTURE_OPACITY = 0.5;
/** @typedef {import("/assets/vector.js").Vector} Vector */
/** The patient frame in itself. @type {import("/assets/vector.js").Pose} */
const HERE = { position: [0, 0, 0], rotation: [0, 0, 0, 1] };
/** @type {Record<"bone" | "inside" | "background", Vector>} */
const LIGHT_SIDE = { bone: [0.93, 0.88, 0.78], inside: [0.78, 0.62, 0.5], background: [0.925, 0.94, 0.955] };
/** @type {Record<"bone" | "inside" | "background", Vector>} */
const DARK_SIDE = { bone: [0.88, 0.83, 0.73], inside: [0.55, 0.4, 0.32], background: [0.07, 0.085, 0.11] };

export class SceneView {
  /** @param {HTMLCanvasElement} canvas @param {() => void} changed requests a redraw */
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.software = SOFTWARE;
    // Smoothing edges in software takes several times as long.
    const gl = canvas.getContext("webgl2", { antialias: !this.software, alpha: false });
    if (!gl) throw new Error("this browser does not support WebGL 2");
    this.gl = gl;
    this.camera = new Camera(changed);
    this.camera.listen(canvas);
    this.surface = new Surface(gl, this.software);
    /** Links of the arm that have a mesh, by the frame they move with. */
    this.arm = new Surface(gl);
    /** Structures that have a mesh, by their index in the scene. */
    this.structureMeshes = new Surface(gl);
    this.parts = program(gl, PART_VERTEX, PART_FRAGMENT);
    this.bone = program(gl, SURFACE_VERTEX, SURFACE_FRAGMENT);
    const upload = (corners) => Object.fromEntries(Object.entries(shapes(corners)).map(([name, shape]) => [name, new InstancedShape(gl, shape)]));
    this.fine = upload(FINE);
    this.light = this.software ? upload(LIGHT) : this.fine;
    this.boneMode = BONE_MODES[0];
    /** @type {import("/assets/structures.js").Structures | undefined} */
    this.structures = undefined;
    /** Cross-hair and distances. @type {import("/assets/cursor.js").Cursor | undefined} */
    this.cursor = undefined;
    /** @type {import("/assets/measure.js").Measures | undefined} */
    this.measures = undefined;
    this.dark = false;
    this.pictures = 0;
    /** Whether the next picture has every pixel, and whether all have, for a video. */
    this.sharp = false;
    this.filmed = false;
    this.detail = new Detail();
    /** Whether the last picture had the detail of a changing view. */
    this.moving = false;
    /** When the picture being rendered was begun, and when it was last found unfinished. */
    this.begun = this.unfinished = 0;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.stillness = undefined;
    gl.enable(gl.DEPTH_TEST);
    // Colours are premultiplied by their opacity.
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  nextBoneMode() {
    this.boneMode = BONE_MODES[(BONE_MODES.indexOf(this.boneMode) + 1) % BONE_MODES.length];
    this.changed();
    return this.boneMode;
  }

  /** Pixels per pixel of the page. */
  #ratio() {
    if (!this.software) return Math.min(window.devicePixelRatio || 1, 2);
    clearTimeout(this.stillness);
    this.moving = !this.sharp && !this.filmed;
    if (!this.moving) return 1;
    this.#sharpen();
    return this.detail.ratio;
  }

  /** Requests a picture with every pixel once the view is still. A slow picture is no stillness. */
  #sharpen() {
    this.stillness = setTimeout(() => (this.busy ? this.#sharpen() : ((this.sharp = true), this.changed())), STILL_MS);
  }

  #resize() {
    const ratio = this.#ratio();
    this.sharp = false;
    this.shapes = ratio < 1 ? this.light : this.fine;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.gl.viewport(0, 0, width, height);
    return width / height;
  }

  /** Whether the last frame is still being rendered; the next one then waits, so that a slow machine is
   * not flooded. */
  get busy() {
    if (!this.fence) return false;
    if (this.gl.clientWaitSync(this.fence, 0, 0) === this.gl.TIMEOUT_EXPIRED) {
      this.unfinished = performance.now();
      return true;
    }
    this.gl.deleteSync(this.fence);
    this.fence = undefined;
    if (this.moving) this.detail.rendered(Math.max(0, this.unfinished - this.begun));
    return false;
  }

  /** @param {import("/assets/model.js").Model} model */
  draw(model) {
    // State-dependent values are computed once per frame.
    const { info, poses, second, contacts, bodies, trail, clearances } = model;
    const scene = { info, poses, second, contacts, bodies, trail, clearances };
    const { gl, camera } = this;
    const colours = this.dark ? DARK_SIDE : LIGHT_SIDE;
    if (scene.poses && camera.follows) camera.centre = scene.poses.burr.position;
    const clipFromWorld = camera.clipFromWorld(this.#resize());
    gl.clearColor(...colours.background, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.#drawParts(this.#opaque(scene), clipFromWorld);
    this.#drawBone(scene, clipFromWorld, colours);
    this.#drawStructures(clipFromWorld);
    this.#drawTranslucent(scene, clipFromWorld);
    this.begun = performance.now();
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.pictures += 1;
  }

  #opaque({ info, poses, contacts, bodies, trail, clearances }) {
    const list = new PartsList();
    if (poses && info?.tool) addTool(list, poses, info.tool, toolColour(clearances));
    addContacts(list, contacts);
    addBodies(list, info?.bodies ?? [], bodies);
    list.path(info?.scene?.planned_path_m ?? [], 0.00045, COLOURS.planned, 0.001);
    list.path(trail.points, 0.0004, COLOURS.drilled);
    if (info?.scene?.target_m) list.target(info.scene.target_m, 0.004, COLOURS.target);
    addFrustum(list, info);
    if (this.cursor?.point && !this.cursor.follows) list.target(this.cursor.point, 0.006, COLOURS.cursor);
    for (const { from, to } of this.measures?.lines ?? []) list.path([from, to], 0.0005, COLOURS.measure);
    if (this.measures?.begun) list.sphere(this.measures.begun, 0.001, COLOURS.measure);
    return list;
  }

  /** @param {import("/assets/tool_model.js").Poses} [before] parts in front of this tool fade */
  #drawParts(list, clipFromWorld, before) {
    const { gl, parts } = this;
    gl.useProgram(parts.linked);
    gl.uniform1f(parts.uniforms.u_fade, before ? FADE_M : 0);
    gl.uniform3fv(parts.uniforms.u_toolBase, before?.base.position ?? [0, 0, 0]);
    gl.uniform3fv(parts.uniforms.u_tip, before?.burr.position ?? [0, 0, 0]);
    gl.uniformMatrix4fv(parts.uniforms.u_clipFromWorld, false, clipFromWorld);
    gl.uniform3fv(parts.uniforms.u_eye, this.camera.eye);
    for (const [name, numbers] of Object.entries(list.shapes)) this.shapes[name].draw(numbers);
  }

  /** Draws the front sides of the structures, which hide nothing. */
  #drawStructures(clipFromWorld) {
    const { gl } = this;
    const shown = this.structures?.shown ?? [];
    if (shown.length === 0) return;
    this.#drawParts(new PartsList(), clipFromWorld);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const { index, colour: [red, green, blue] } of shown) {
      const mesh = this.structureMeshes.blocks.get(index);
      if (mesh) this.#drawMesh(mesh, HERE, [red, green, blue, STRUCTURE_OPACITY]);
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
  }

  /** Draws the arm, which would hide the bone, and the tool of the second log: only their foremost
   * surface. */
  #drawTranslucent({ info, poses, second }, clipFromWorld) {
    const { gl } = this;
    const list = new PartsList();
    if (poses) addArm(list, poses, this.arm.blocks);
    addPlannedTool(list, info);
    if (second && info?.tool) addTool(list, second, info.tool, COLOURS.second);
    gl.colorMask(false, false, false, false);
    this.#drawParts(list, clipFromWorld);
    this.#drawLinks(poses);
    gl.colorMask(true, true, true, true);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    this.#drawParts(list, clipFromWorld, poses);
    this.#drawLinks(poses);
    gl.disable(gl.BLEND);
    gl.depthFunc(gl.LESS);
  }

  /** Draws the arm's meshes with the current program. */
  #drawLinks(poses) {
    if (!poses || poses.arm.length === 0) return;
    const frames = [...poses.arm, poses.flange];
    for (const [link, mesh] of this.arm.blocks) this.#drawMesh(mesh, frames[link], COLOURS.arm);
  }

  /** Draws a mesh with the current program; the per-instance attributes are constant for it. */
  #drawMesh({ vertexArray, indexCount, origin, scale }, pose, colour) {
    const { gl } = this;
    gl.bindVertexArray(vertexArray);
    gl.vertexAttrib3fv(2, transform(pose, origin));
    gl.vertexAttrib4fv(3, pose.rotation);
    gl.vertexAttrib3f(4, scale, scale, scale);
    gl.vertexAttrib4fv(5, colour);
    gl.drawElements(gl.TRIANGLES, indexCount, gl.UNSIGNED_INT, 0);
  }

  /** Returns the point on bone or burr under a pixel, else the one nearest to the cross-hair. @param {number} x @param {number} y pixels of the page */
  placeAt(x, y, model) {
    const { camera, canvas, boneMode } = this;
    const ray = cameraRay(camera, x, y, canvas.clientWidth, canvas.clientHeight);
    const { poses, info } = model;
    const balls = poses ? burrBalls(poses, info?.tool) : [];
    const cut = boneMode === "section" && poses ? bendingPlane(poses.base, camera.eye) : [0, 0, 0, 0];
    const blocks = boneMode === "hidden" ? [] : this.surface.blocks.values();
    return pick(ray, blocks, cut, balls) ?? nearest(ray, this.cursor?.point ?? camera.centre);
  }

  #drawBone(scene, clipFromWorld, colours) {
    const { gl, bone, boneMode } = this;
    if (boneMode === "hidden" || this.surface.blocks.size === 0) return;
    const { uniforms } = bone;
    gl.useProgram(bone.linked);
    gl.uniformMatrix4fv(uniforms.u_clipFromWorld, false, clipFromWorld);
    gl.uniform3fv(uniforms.u_eye, this.camera.eye);
    gl.uniform3fv(uniforms.u_bone, colours.bone);
    gl.uniform3fv(uniforms.u_inside, colours.inside);
    const cut = boneMode === "section" && scene.poses ? bendingPlane(scene.poses.base, this.camera.eye) : undefined;
    gl.uniform4fv(uniforms.u_plane, cut ?? [0, 0, 0, 0]);
    const pass = (side, glass) => {
      gl.uniform1f(uniforms.u_side, side);
      gl.uniform1f(uniforms.u_glass, glass);
      if (glass) gl.enable(gl.BLEND);
      gl.depthMask(!glass);
      this.surface.draw(uniforms, side, cut);
      gl.disable(gl.BLEND);
      gl.depthMask(true);
    };
    if (cut) {
      pass(1, 0);
      pass(-1, 1);
    } else {
      pass(0, boneMode === "glass" || boneMode === "section" ? 1 : 0);
    }
  }
}
