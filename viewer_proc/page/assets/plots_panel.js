// The plots below the scene: all on one time axis, with one cursor.

import { Plot, timeAt } from "/assets/plot.js";
import { STATE_VALUES } from "/assets/model.js";

const DEGREES = 180 / Math.PI;
const RPM = 60 / (2 * Math.PI);
/** Lengths of the time axis to choose from, seconds. */
const WINDOWS = [1, 2, 5, 10, 20, 60];

/** Title, unit, smallest span, and lines: field, label, scale. */
const PLOTS = [
  ["Tension", "N", 2, [["tendon_tension_n[0]", "tendon 0", 1], ["tendon_tension_n[1]", "tendon 1", 1]]],
  ["Bend", "°", 5, [["bend_rad", "bend", DEGREES]]],
  ["Burr force", "N", 1, [["burr_force_n", "force", 1]]],
  ["Burr speed", "rpm", 1000, [["burr_speed_rad_per_s", "speed", RPM]]],
];

/** Two digits behind the point for small numbers; no minus before a zero. */
const written = (value) => (Math.abs(value) >= 100 ? value.toFixed(0) : (Math.abs(value) < 0.005 ? 0 : value).toFixed(2));

export class PlotsPanel {
  /** @param {HTMLElement} place @param {import("/assets/model.js").Model} model @param {() => void} changed */
  constructor(place, model, changed) {
    this.model = model;
    this.changed = changed;
    this.seconds = 10;
    const stateLines = (lines) => lines.flatMap(([field, label, scale], i) => {
      const which = STATE_VALUES.indexOf(field);
      const colour = `--series-${i + 1}`;
      const second = { label: `${label}, second`, series: model.secondStates, which, scale, colour: "--series-4", dashed: true };
      const shown = () => model.secondStates.lastTime !== undefined;
      return [{ label, series: model.states, which, scale, colour }, { ...second, shown }];
    });
    const definitions = PLOTS.map(([title, unit, least, lines]) => ({ title, unit, least, lines: stateLines(lines) }));
    const step = { label: "step", series: model.timing, which: 0, scale: 1, colour: "--series-1" };
    definitions.push({ title: "Step time", unit: "µs", least: 100, lines: [step] });
    this.plots = definitions.map((definition) => this.#make(place, definition));
  }

  #make(place, { title, unit, least, lines }) {
    const box = place.appendChild(document.createElement("div"));
    box.className = "plot";
    const head = box.appendChild(document.createElement("h2"));
    head.append(title);
    head.appendChild(document.createElement("span")).textContent = unit;
    const values = head.appendChild(document.createElement("span"));
    values.className = "values";
    const canvas = box.appendChild(document.createElement("canvas"));
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${title} over time`);
    canvas.addEventListener("pointermove", (event) => this.#point(timeAt(canvas, event.clientX, ...this.range())));
    canvas.addEventListener("pointerleave", () => this.#point(undefined));
    return { plot: new Plot(canvas, lines, least), values, canvas, title, unit };
  }

  #point(time) {
    this.cursor = time;
    this.changed();
  }

  /** The next longer or shorter time axis. @param {1 | -1} direction */
  changeWindow(direction) {
    const at = WINDOWS.indexOf(this.seconds) + direction;
    this.seconds = WINDOWS[Math.max(0, Math.min(WINDOWS.length - 1, at))];
    this.changed();
  }

  /** Begin and end of the time axis, which begins at 0 s or later. @returns {[number, number]} */
  range() {
    const end = Math.max(this.seconds, this.model.states.lastTime ?? 0);
    return [end - this.seconds, end];
  }

  /** @param {Record<string, string>} colours */
  draw(colours) {
    const [from, to] = this.range();
    for (const { plot } of this.plots) plot.draw(from, to, colours, this.cursor);
  }

  /** The values at the cursor, or the newest, as text with the line's colour and dash. */
  showValues(colours) {
    for (const { plot, values, canvas, title, unit } of this.plots) {
      const shown = plot.lines.filter((line) => line.shown?.() ?? true);
      const texts = shown.map((line) => {
        const value = this.cursor === undefined ? line.series.last(line.which) : line.series.at(line.which, this.cursor);
        return { line, text: value === undefined ? "–" : written(value * line.scale) };
      });
      values.replaceChildren(...texts.map(({ line, text }) => {
        const item = document.createElement("span");
        item.style.color = colours[line.colour];
        item.className = line.dashed ? "value dashed" : "value";
        item.textContent = text;
        item.title = line.label;
        return item;
      }));
      canvas.setAttribute("aria-label", `${title}: ${texts.map(({ line, text }) => `${line.label} ${text} ${unit}`).join(", ")}`);
    }
  }
}
