// The plots below the scene: any fields of any messages, on one time axis, with one cursor.

import { FieldPicker } from "/assets/field_picker.js";
import { stored, store } from "/assets/kept.js";
import { LiveSeries } from "/assets/live_series.js";
import { LogSeries, keyOf } from "/assets/log_series.js";
import { Plot, prepare, textScale, timeAt } from "/assets/plot.js";
import { TimeAxis } from "/assets/time_axis.js";
import { labelOf, unitOf, written } from "/assets/units.js";

/** Storage key of the layout. */
const KEPT = "plots";
/** Field drawn by the tick strip. */
export const STEP_TIME = { topic: "/timing/tick", field: "step_ns" };
const MOST_PLOTS = 12;
const MOST_LINES = 4;
/** A pointer that moved less than this, in pixels, counts as a click. */
const CLICK_PX = 4;

/** Whether the window is narrow; the wheel then scrolls the page (`layout.css`). */
const scrolls = () => getComputedStyle(document.body).overflowY !== "hidden";

/** @typedef {{title?: string, fields: import("/assets/log_series.js").FieldName[], least?: number}} PlotChoice */
const state = (field) => ({ topic: "/state", field });
/** @type {PlotChoice[]} `least`: minimum span of the vertical axis, in the displayed unit */
const DEFAULT = [
  { title: "Tension", fields: [state("tendon_tension_n[0]"), state("tendon_tension_n[1]")], least: 2 },
  { title: "Bend", fields: [state("bend_rad")], least: 5 },
  { title: "Burr force", fields: [state("burr_force_n")], least: 1 },
  { title: "Burr speed", fields: [state("burr_speed_rad_per_s")], least: 1000 },
  { title: "Step time", fields: [STEP_TIME], least: 100 },
];

/** Returns the stored layout, if valid. @returns {PlotChoice[]} */
function choices() {
  const kept = stored(KEPT);
  const isField = (name) => typeof name?.topic === "string" && typeof name?.field === "string";
  const isPlot = (one) => Array.isArray(one?.fields) && one.fields.length > 0 && one.fields.length <= MOST_LINES && one.fields.every(isField);
  return Array.isArray(kept) && kept.length <= MOST_PLOTS && kept.every(isPlot) ? kept : structuredClone(DEFAULT);
}

export class PlotsPanel {
  /**
   * @param {HTMLElement} place @param {import("/assets/model.js").Model} model
   * @param {{changed: () => void, ask: (request: object) => Promise<any>, subscribe: (topics: Set<string>) => void,
   *   channels: () => Iterable<import("/assets/connection.js").Channel>, seek: (seconds: number) => void}}
   *   page
   */
  constructor(place, model, page) {
    this.place = place;
    this.model = model;
    this.page = page;
    this.changed = page.changed;
    this.axis = new TimeAxis();
    this.live = new LiveSeries();
    this.logs = [false, true].map((second) => new LogSeries(page.ask, page.changed, second));
    this.picker = new FieldPicker(page.channels, (plot, name) => this.add(plot, name));
    this.choices = choices();
    /** @type {{choice: PlotChoice, plot: Plot, values: HTMLElement, canvas: HTMLCanvasElement, title: string, unit: string}[]} */
    this.plots = [];
    this.#build();
  }

  get isLog() {
    return this.model.info?.kind === "log";
  }

  /** Resets for a new connection. */
  clear() {
    this.live.clear();
    this.logs.forEach((log) => log.clear());
  }

  /** The plotted fields, and that of the tick strip. */
  #fields() {
    const all = [...this.choices.flatMap((choice) => choice.fields), STEP_TIME];
    return [...new Map(all.map((name) => [keyOf(name), name])).values()];
  }

  /** Rebuilds the plots from the choices. */
  #build() {
    this.place.replaceChildren();
    this.plots = this.choices.map((choice) => this.#make(choice));
    this.live.keep(this.#fields());
    this.page.subscribe(this.live.topics);
    this.changed();
  }

  #keep() {
    store(KEPT, this.choices);
    this.#build();
  }

  /** Adds a field to a plot, or a new plot for it. @param {number | undefined} at @param {import("/assets/log_series.js").FieldName} name */
  add(at, name) {
    const choice = at === undefined ? undefined : this.choices[at];
    if (choice) {
      if (choice.fields.length >= MOST_LINES || choice.fields.some((one) => keyOf(one) === keyOf(name))) return;
      choice.fields.push(name);
    } else if (this.choices.length < MOST_PLOTS) this.choices.push({ fields: [name] });
    this.#keep();
  }

  #remove(choice, field) {
    choice.fields = choice.fields.filter((one) => one !== field);
    if (choice.fields.length === 0) this.choices = this.choices.filter((one) => one !== choice);
    this.#keep();
  }

  /** Restores the default plots. */
  restore() {
    this.choices = structuredClone(DEFAULT);
    this.axis.reset();
    this.#keep();
  }

  #make(choice) {
    const [first] = choice.fields;
    const { unit } = unitOf(first.field);
    const title = choice.title ?? labelOf(first.field);
    const box = this.place.appendChild(document.createElement("div"));
    box.className = "plot";
    const head = box.appendChild(document.createElement("h2"));
    head.append(title);
    head.appendChild(document.createElement("span")).textContent = unit;
    head.append(this.#button("add", choice, "+", `Add a line to ${title}`, () => this.picker.open(this.choices.indexOf(choice))));
    head.append(this.#button("remove", choice, "×", `Remove the plot ${title}`, () => ((this.choices = this.choices.filter((one) => one !== choice)), this.#keep())));
    const values = head.appendChild(document.createElement("span"));
    values.className = "values";
    const canvas = box.appendChild(document.createElement("canvas"));
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${title} over time`);
    this.#listen(canvas);
    this.#takeDrops(box, choice);
    return { choice, plot: new Plot([], unit, choice.least ?? 1e-9), values, canvas, title, unit };
  }

  /** Gives each button a unique name, so that tools and tests can tell it from those of the other plots. */
  #button(what, choice, text, label, act) {
    const button = document.createElement("button");
    button.id = `plot-${this.choices.indexOf(choice)}-${what}`;
    Object.assign(button, { textContent: text, title: label, className: "small" });
    button.setAttribute("aria-label", label);
    button.addEventListener("click", act);
    return button;
  }

  /** Adds a field dropped from the list as a line. */
  #takeDrops(box, choice) {
    box.addEventListener("dragover", (event) => event.preventDefault());
    box.addEventListener("drop", (event) => {
      const name = this.picker.dragged;
      if (!name) return;
      event.preventDefault();
      this.add(this.choices.indexOf(choice), name);
    });
  }

  /** Wheel: zoom; drag: pan; click: seek in a log; double click: show everything. */
  #listen(canvas) {
    let pressed;
    const time = (event) => timeAt(canvas, event.clientX, ...this.range());
    canvas.addEventListener("wheel", (event) => {
      const about = time(event);
      if (about === undefined || (scrolls() && !event.ctrlKey && !event.shiftKey)) return;
      event.preventDefault();
      this.axis.zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 300))), about);
      this.changed();
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      pressed = { x: event.clientX, last: event.clientX, moved: false };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (pressed) {
        pressed.moved ||= Math.abs(event.clientX - pressed.x) > CLICK_PX;
        const [from, to] = this.range();
        if (pressed.moved) this.axis.pan(((pressed.last - event.clientX) / Math.max(1, canvas.clientWidth)) * (to - from));
        pressed.last = event.clientX;
      }
      this.#point(time(event));
    });
    canvas.addEventListener("pointerup", (event) => {
      const at = time(event);
      if (pressed && !pressed.moved && at !== undefined && this.isLog) this.page.seek(at);
      pressed = undefined;
    });
    canvas.addEventListener("pointercancel", () => (pressed = undefined));
    canvas.addEventListener("pointerleave", () => this.#point(undefined));
    canvas.addEventListener("dblclick", () => (this.axis.reset(), this.changed()));
  }

  #point(time) {
    this.cursor = time;
    this.changed();
  }

  /** Selects the next longer or shorter time axis. @param {1 | -1} direction */
  changeWindow(direction) {
    this.axis.step(direction);
    this.changed();
  }

  /** Begin and end of the time axis, seconds. @returns {[number, number]} */
  range() {
    return this.axis.range();
  }

  /** @returns {import("/assets/plot.js").Times} */
  times() {
    const [from, to] = this.range();
    return { from, to, cursor: this.cursor, now: this.isLog ? this.axis.now : undefined };
  }

  /** Returns the samples of a field of the run or the first log. @param {import("/assets/log_series.js").FieldName} name */
  samples(name) {
    return this.isLog ? this.logs[0].field(name) : this.live.field(name);
  }

  /** Returns the known misses, for the tick strip. @returns {import("/assets/timing_strip.js").Miss[]} */
  misses() {
    if (!this.isLog) return this.model.misses;
    const { span } = this.logs[0];
    if (!span) return [];
    const wide = (span.to - span.from) / span.columns;
    return span.misses.at.map((column, i) => ({ time: span.from + column * wide, letter: span.misses.letters[i], count: span.misses.count[i] }));
  }

  #lines(choice, second) {
    const scales = choice.fields.map((name) => ({ name, scale: unitOf(name.field).scale }));
    const own = scales.map(({ name, scale }, i) => ({ name, label: labelOf(name.field), samples: this.samples(name), scale, colour: `--series-${i + 1}` }));
    if (!second) return own;
    const others = scales.map(({ name, scale }, i) => ({ name, label: `${labelOf(name.field)}, second log`, samples: this.logs[1].field(name), scale, colour: `--series-${((i + 3) % 4) + 1}`, dashed: true }));
    return [...own, ...others];
  }

  /** Whether a second log is shown. */
  get #second() {
    return document.body.classList.contains("compare");
  }

  /** @param {Record<string, string>} colours */
  draw(colours) {
    const [times, size] = [this.times(), textScale()];
    if (this.isLog) this.#ask(times);
    for (const one of this.plots) {
      one.plot.lines = this.#lines(one.choice, this.#second);
      const { context, width, height } = prepare(one.canvas);
      one.plot.draw(context, width, height, times, colours, size);
    }
  }

  #ask({ from, to }) {
    // The tick strip is as wide as all plots together.
    const columns = Math.ceil(Math.max(200, this.place.clientWidth) * (window.devicePixelRatio || 1));
    const end = this.axis.log?.[1] ?? to;
    this.logs[0].want(this.#fields(), from, to, columns, end);
    if (this.#second) this.logs[1].want(this.#fields(), from, to, columns, end);
  }

  /** Fraction of the shown data that the server has read from the logs, 0 to 1; undefined when complete. @returns {number | undefined} */
  get reading() {
    const shares = this.logs.map((log) => log.reading).filter((share) => share !== undefined);
    return this.isLog && shares.length > 0 ? Math.min(...shares) : undefined;
  }

  /** A line's value at the cursor, or the newest one, or that at a log's position. */
  value(line) {
    if (this.cursor !== undefined) return line.samples.at(this.cursor);
    if (!this.isLog) return line.samples.last();
    return this.model.field(line.name, !!line.dashed) ?? line.samples.at(this.axis.now);
  }

  /** Shows these values as text with the line's colour and dash. Double-clicking one removes its line. */
  showValues(colours) {
    for (const { choice, plot, values, canvas, title, unit } of this.plots) {
      const texts = plot.lines.map((line) => {
        const value = this.value(line);
        return { line, text: value == null ? "–" : written(value * line.scale) };
      });
      values.replaceChildren(...texts.map(({ line, text }) => {
        const item = document.createElement("span");
        item.style.color = colours[line.colour];
        item.className = line.dashed ? "value dashed" : "value";
        item.textContent = text;
        item.title = `${line.label}, ${line.name.topic} ${line.name.field}${choice.fields.length > 1 ? "; double-click to remove the line" : ""}`;
        item.addEventListener("dblclick", () => choice.fields.length > 1 && this.#remove(choice, line.name));
        return item;
      }));
      canvas.setAttribute("aria-label", `${title}: ${texts.map(({ line, text }) => `${line.label} ${text} ${unit}`).join(", ")}`);
    }
  }
}
