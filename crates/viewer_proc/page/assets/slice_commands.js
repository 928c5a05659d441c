// Actions of keys and buttons for slices, distances and the X-ray's size.

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

/** @param {string} className @param {string} button the button that shows the state */
function toggleBody(className, button) {
  const on = document.body.classList.toggle(className);
  element(button).setAttribute("aria-pressed", String(on));
}

/**
 * @param {object} page slices, cursor, measures, xRayOverlay, changed
 * @returns {import("/assets/actions.js").Action[]}
 */
export function sliceCommands(page) {
  const { slices, cursor, measures, xRayOverlay } = page;
  const there = () => slices.there;
  const large = () => document.body.classList.contains("x-ray-large");
  const enlarge = () => {
    toggleBody("x-ray-large", "x-ray-large");
    page.changed("xRay");
  };
  const plan = () => {
    xRayOverlay.on = !xRayOverlay.on;
    element("x-ray-plan").setAttribute("aria-pressed", String(xRayOverlay.on));
    page.changed("xRay");
  };
  return [
    { id: "slices", group: "Slices", keys: ["4"], text: "show or hide the slices", when: there, run: () => slices.toggle() },
    { id: "slices-follow", group: "Slices", keys: ["0"], text: "cross-hair: follow the tip, or stay", when: there, run: () => cursor.toggle() },
    { id: "slices-closer", group: "Slices", keys: [], text: "closer", when: there, run: () => slices.zoom(0.8) },
    { id: "slices-wider", group: "Slices", keys: [], text: "wider", when: there, run: () => slices.zoom(1.25) },
    { id: "measure", group: "Slices", keys: ["u"], text: "measure: two clicks in slices, 3D view or X-ray", run: () => measures.toggle() },
    { id: "measure-clear", group: "Slices", keys: ["Delete"], text: "delete all distances", run: () => measures.clear() },
    { id: "x-ray-large", group: "X-ray", keys: ["z"], text: "enlarge or shrink", run: enlarge },
    { id: "x-ray-small", group: "X-ray", keys: ["Escape"], text: "small", when: large, run: enlarge },
    { id: "x-ray-plan", group: "X-ray", keys: [], text: "overlay plan and tool", run: plan },
  ];
}
