// Overlay on the 3D view: distances with their values, and movable points.

import { drawHandles } from "/assets/plan_edit.js";
import { textScale } from "/assets/plot.js";
import { drawMeasures } from "/assets/slice_tile.js";
import { context2d } from "/assets/software.js";
import { project } from "/assets/vector.js";

export class SceneOverlay {
  /**
   * @param {HTMLCanvasElement} canvas over the 3D view @param {import("/assets/scene_view.js").SceneView} view
   * @param {import("/assets/measure.js").Measures} measures @param {import("/assets/plan_edit.js").PlanEdit} edit
   */
  constructor(canvas, view, measures, edit) {
    this.canvas = canvas;
    this.view = view;
    this.measures = measures;
    this.edit = edit;
    /** State shown on the canvas. */
    this.key = "";
  }

  /** Projects a point, page pixels; undefined behind the eye. @param {import("/assets/vector.js").Vector} point */
  pixelOf(point) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const [x, y, , w] = project(this.view.camera.clipFromWorld(width / height), point);
    return w > 0 ? [(0.5 + (0.5 * x) / w) * width, (0.5 - (0.5 * y) / w) * height] : undefined;
  }

  /** Draws only on change: the canvas lies over the 3D view, and compositing both takes time. */
  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    const clipFromWorld = this.view.camera.clipFromWorld(width / height);
    const { handles } = this.edit;
    const isEmpty = this.measures.lines.length === 0 && !this.measures.begun && handles.length === 0;
    const key = isEmpty ? "" : [width, height, this.measures.version, this.edit.version, ...clipFromWorld].join();
    if (key === this.key) return;
    this.key = key;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const context = context2d(this.canvas);
    context.clearRect(0, 0, width, height);
    /** @param {import("/assets/vector.js").Vector} point */
    const at = (point) => this.pixelOf(point)?.map((x) => x * ratio);
    const mark = ratio * textScale();
    drawMeasures(context, this.measures, at, mark);
    drawHandles(context, handles, at, mark);
  }
}
