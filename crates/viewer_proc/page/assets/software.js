// Whether the browser renders in software: then pictures have fewer triangles and pixels (scene_view.js), 2D
// canvases are drawn by the processor at once instead of by an emulated graphics card, and messages of each
// tick are thinned out (connection.js).

export const SOFTWARE = (() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl?.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return !gl || /swiftshader|llvmpipe|software/i.test(name);
})();

/** @param {HTMLCanvasElement} canvas @returns {CanvasRenderingContext2D} */
export const context2d = (canvas) => canvas.getContext("2d", { willReadFrequently: SOFTWARE });
