// The time line of a log: position, marks for events, misses, divergences and gaps, each with a letter.

import { prepare, textScale } from "/assets/plot.js";

/** @type {Record<string, {letter: string, name: string, colour: string}>} */
const MARKS = {
  event: { letter: "E", name: "warning or error", colour: "--accent" },
  note: { letter: "", name: "note", colour: "--muted" },
  miss: { letter: "M", name: "missed tick", colour: "--cause-step" },
  divergence: { letter: "D", name: "divergence", colour: "--error" },
  gap: { letter: "G", name: "gap", colour: "--cause-fault" },
};
const SMALL_LETTER_PX = 10;
/** Time after its last movement during which the thumb counts as held. */
const DRAGGED_MS = 400;
const STEPS = 10000;

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
const seconds = (ns) => `${(ns / 1e9).toFixed(3)} s`;

export class TimeLine {
  /**
   * @param {(request: object) => void} send a `/playback` request
   * @param {() => void} redraw
   */
  constructor(send, redraw) {
    this.send = send;
    this.state = { begin_ns: 0, end_ns: 0, time_ns: 0, playing: false, speed: 1, second: false, reading: null, missed: 0, missed_total: 0, has_timing: false };
    this.events = [];
    const scrub = element("scrub");
    scrub.max = String(STEPS);
    scrub.addEventListener("input", () => {
      this.scrubbing = performance.now();
      // Playback may have moved and stopped meanwhile, which leaves the thumb elsewhere.
      setTimeout(redraw, DRAGGED_MS + 20);
      const share = Number(scrub.value) / STEPS;
      this.send({ action: "seek", time_ns: Math.round(this.state.begin_ns + share * (this.state.end_ns - this.state.begin_ns)) });
    });
    element("playback-speed").addEventListener("change", (event) => this.send({ action: "speed", speed: Number(event.target.value) }));
  }

  /** @param {object} state a `/view/playback` message; events only if they have changed */
  take(state) {
    this.state = { ...this.state, ...state };
    if (state.events) this.events = state.events;
  }

  togglePlay() {
    this.send({ action: this.state.playing ? "pause" : "play" });
  }

  /** Plays faster or slower: selects the next entry of the list. @param {1 | -1} direction */
  changeSpeed(direction) {
    const list = element("playback-speed");
    list.selectedIndex = Math.max(0, Math.min(list.options.length - 1, list.selectedIndex + direction));
    list.dispatchEvent(new Event("change"));
  }

  draw(colours) {
    const { begin_ns, end_ns, time_ns, playing } = this.state;
    const span = Math.max(1, end_ns - begin_ns);
    element("play").textContent = playing ? "Pause" : "Play";
    element("playback-time").textContent = `${seconds(time_ns)} of ${seconds(end_ns)}`;
    const scrub = element("scrub");
    // While the user drags, the server's messages do not move the thumb.
    if (!(performance.now() - (this.scrubbing ?? -Infinity) < DRAGGED_MS)) scrub.value = String(Math.round(((time_ns - begin_ns) / span) * STEPS));
    scrub.setAttribute("aria-valuetext", seconds(time_ns));
    this.#marks(begin_ns, span, time_ns, colours);
  }

  #marks(begin, span, now, colours) {
    const { context, width, height } = prepare(element("marks"));
    const letterPx = SMALL_LETTER_PX * textScale();
    context.font = `bold ${letterPx}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "top";
    const lastLetter = {};
    // Notes must not hide more important marks: they are drawn first, short and without a letter.
    const ordered = [...this.events.filter(({ kind }) => kind === "note"), ...this.events.filter(({ kind }) => kind !== "note")];
    for (const { time_ns, kind } of ordered) {
      const mark = MARKS[kind] ?? MARKS.event;
      const x = 8 + ((time_ns - begin) / span) * (width - 16);
      context.fillStyle = colours[mark.colour];
      const top = mark.letter ? letterPx + 1 : height - 4;
      context.fillRect(x - 1, top, mark.letter ? 2 : 1, height - top);
      if (!mark.letter || x - (lastLetter.x ?? -Infinity) < letterPx) continue;
      context.fillText(mark.letter, x, 0);
      lastLetter.x = x;
    }
    const before = this.events.filter(({ time_ns }) => time_ns <= now + 1);
    const near = before.filter(({ kind }) => kind !== "note").at(-1) ?? before.at(-1);
    element("mark-text").textContent = near ? `${MARKS[near.kind]?.name ?? near.kind} at ${seconds(near.time_ns)}: ${near.text}` : "";
  }
}
