// Distances with their numbers over the 3D picture.

import { drawMeasures } from "/assets/slice_tile.js";
import { project } from "/assets/vector.js";

export class SceneOverlay {
  /**
   * @param {HTMLCanvasElement} canvas over the 3D view @param {import("/assets/scene_view.js").SceneView} view
   * @param {import("/assets/measure.js").Measures} measures
   */
  constructor(canvas, view, measures) {
    this.canvas = canvas;
    this.view = view;
    this.measures = measures;
    /** What the canvas shows. */
    this.key = "";
  }

  /** Draws only what is new: the canvas lies over the 3D picture, and to compose both takes time. */

  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    const clipFromWorld = this.view.camera.clipFromWorld(width / height);
    const isEmpty = this.measures.lines.length === 0 && !this.measures.begun;
    const key = isEmpty ? "" : [width, height, this.measures.version, ...clipFromWorld].join();
    if (key === this.key) return;
    this.key = key;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    drawMeasures(context, this.measures, (point) => {
      const [x, y, , w] = project(clipFromWorld, point);
      return w > 0 ? [(0.5 + (0.5 * x) / w) * width, (0.5 - (0.5 * y) / w) * height] : undefined;
    }, ratio);
  }
}
