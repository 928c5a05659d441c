// Which panels are shown, and their sizes; stored in the browser.

import { store, stored } from "/assets/kept.js";

const KEPT = "panels";
/** Hideable panels: id and name. @type {[string, string][]} */
const PANELS = [["plots", "Plots"], ["timing", "Ticks"], ["x-ray", "X-ray"], ["connected", "Parts"], ["log", "Messages"]];
/** Handles: id, style-sheet property, minimum and maximum size in pixels, coordinate, and growth
 * direction. */
const HANDLES = [
  { id: "plots-handle", property: "--plots-height", least: 110, most: 900, key: "clientY", way: -1 },
  { id: "aside-handle", property: "--aside-width", least: 240, most: 1200, key: "clientX", way: -1 },
];
const KEY_STEP_PX = 20;

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

export class PanelLayout {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    const kept = stored(KEPT);
    /** @type {{hidden: string[], sizes: Record<string, number>}} */
    this.layout = { hidden: Array.isArray(kept?.hidden) ? kept.hidden : [], sizes: typeof kept?.sizes === "object" && kept.sizes ? kept.sizes : {} };
    const menu = element("panels-menu");
    for (const [id, name] of PANELS) {
      const label = menu.appendChild(document.createElement("label"));
      const box = label.appendChild(document.createElement("input"));
      box.type = "checkbox";
      box.dataset.panel = id;
      box.addEventListener("change", () => this.#hide(id, !box.checked));
      label.append(` ${name}`);
    }
    HANDLES.forEach((handle) => this.#listen(handle));
    this.#apply();
  }

  #hide(id, hidden) {
    this.layout.hidden = this.layout.hidden.filter((one) => one !== id);
    if (hidden) this.layout.hidden.push(id);
    this.#keep();
  }

  #keep() {
    store(KEPT, this.layout);
    this.#apply();
  }

  #apply() {
    for (const [id] of PANELS) {
      const hidden = this.layout.hidden.includes(id);
      element(id).classList.toggle("put-away", hidden);
      /** @type {HTMLInputElement} */ (document.querySelector(`input[data-panel="${id}"]`)).checked = !hidden;
    }
    for (const { property, least, most } of HANDLES) {
      const size = this.layout.sizes[property];
      if (Number.isFinite(size)) document.body.style.setProperty(property, `${Math.min(most, Math.max(least, size))}px`);
      else document.body.style.removeProperty(property);
    }
    document.body.classList.toggle("no-plots", this.layout.hidden.includes("plots"));
    this.changed();
  }

  #listen({ id, property, least, most, key, way }) {
    const handle = element(id);
    // The panel's own size until one is set: the style sheet's default depends on the window.
    const now = () => this.layout.sizes[property] ?? (key === "clientY" ? handle.parentElement.offsetHeight : handle.parentElement.offsetWidth);
    const set = (value) => ((this.layout.sizes[property] = Math.min(most, Math.max(least, Math.round(value)))), this.#keep());
    let pressed;
    handle.addEventListener("pointerdown", (event) => {
      pressed = { at: event[key], size: now() };
      handle.setPointerCapture(event.pointerId);
    });
    handle.addEventListener("pointermove", (event) => pressed && set(pressed.size + way * (event[key] - pressed.at)));
    for (const end of ["pointerup", "pointercancel"]) handle.addEventListener(end, () => (pressed = undefined));
    handle.addEventListener("keydown", (event) => {
      const steps = { ArrowUp: 1, ArrowLeft: 1, ArrowDown: -1, ArrowRight: -1 }[event.key];
      if (!steps) return;
      event.preventDefault();
      event.stopPropagation();
      set(now() + steps * KEY_STEP_PX);
    });
  }

  /** Shows all panels at their default size. */
  restore() {
    this.layout = { hidden: [], sizes: {} };
    store(KEPT, undefined);
    this.#apply();
  }
}
