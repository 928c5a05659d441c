// The readouts: state of the run, frame, ticks, stream.

import { causeOf, countCauses } from "/assets/timing_strip.js";

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
const PHASE_WORDS = { connecting: "Connecting", running: "Running", paused: "Paused", ended: "Ended", lost: "Not connected" };
/** A running session without a state for this long triggers a warning. */
const SILENT_MS = 2000;

const set = (id, text) => {
  const place = element(id);
  if (place.textContent !== text) place.textContent = text;
};

/** Simulated over wall-clock time during the last second or so. */
export class Rate {
  samples = [];

  /** @param {number | undefined} simulated seconds @param {number} now milliseconds */
  add(simulated, now) {
    if (simulated === undefined) return undefined;
    this.samples.push({ simulated, now });
    while (this.samples.length > 2 && now - this.samples[0].now > 1500) this.samples.shift();
    const first = this.samples[0];
    const rate = ((simulated - first.simulated) * 1000) / (now - first.now);
    if (rate < 0) this.samples = [];
    return now > first.now && rate >= 0 ? rate : undefined;
  }
}

/** @param {import("/assets/model.js").Model} model @param {boolean} connected @param {object} playback state of the time line */
export function showRun(model, connected, playback, rate) {
  const isLog = model.info?.kind === "log";
  const phase = !connected ? (model.hasEnded ? "ended" : "lost") : isLog ? (playback.playing ? "running" : "paused") : model.phase;
  const held = phase === "running" && model.pace ? ` at ${model.pace} ×` : "";
  const isPlan = model.info?.kind === "plan" && connected;
  set("phase", isPlan ? "Before the run" : isLog && connected ? (playback.playing ? "Playing" : "Paused") : PHASE_WORDS[phase] + held);
  element("phase").dataset.state = phase;
  set("scene-name", model.info?.scene?.name ?? "waiting for the scene");
  // The end of a long path distinguishes the logs.
  const path = model.info?.path ?? "";
  set("kind", isLog || isPlan ? `${model.info.kind} ${path.split("/").slice(-2).join("/")}` : model.info ? `live, ${model.info.scene?.mode ?? ""}` : "");
  element("kind").title = path;
  set("pause", phase === "paused" ? "Resume" : "Pause");
  const tickCount = model.status?.tick_count || (isLog && model.info.scene?.tick_count);
  set("tick", model.tick === undefined ? "–" : `${model.tick}${tickCount ? ` / ${tickCount}` : ""}`);
  const time = isLog ? playback.time_ns / 1e9 : model.time;
  set("time", time === undefined ? "–" : `${time.toFixed(3)} s`);
  set("rate", rate === undefined || phase !== "running" ? "–" : `${rate.toFixed(2)} ×`);
  if (isLog) set("missed", playback.has_timing ? `${playback.missed} of ${playback.missed_total}` : "–");
  else set("missed", model.status ? `${model.status.missed_ticks}` : "–");
  set("drilled", model.removed === undefined ? "–" : `${model.removed} voxels`);
}

/** Warning text if a run is silent, or undefined. */
export function silence(model, connected, now) {
  if (!connected || model.info?.kind !== "live" || model.phase !== "running" || model.stateAt === undefined) return undefined;
  const silent = now - model.stateAt;
  return silent > SILENT_MS ? `No state for ${(silent / 1000).toFixed(0)} s: the physics may have stopped.` : undefined;
}

/** @param {import("/assets/model.js").Model} model @param {import("/assets/x_ray.js").XRay} xRay */
export function showFrame(model, xRay) {
  const frame = xRay.held ? model.heldFrame : model.frame;
  const degrees = (angle) => `${((angle * 180) / Math.PI).toFixed(1)}°`;
  const angles = frame?.primary === undefined ? "" : `, ${degrees(frame.primary)} / ${degrees(frame.secondary)}`;
  const held = xRay.held ? "requested, held:  " : "";
  set("frame-facts", frame ? `${held}frame ${frame.sequence}, tick ${frame.tick}${angles}` : "no frame yet");
  element("x-ray-live").hidden = !xRay.held;
  set("window-facts", xRay.image ? `level ${xRay.window.level.toFixed(0)}, width ${xRay.window.width.toFixed(0)}` : "");
  const words = { both: "both", first: "first", second: "second", difference: "first − second" };
  set("x-ray-source", `Show: ${words[xRay.shows]}`);
}

/** Tick facts, with the causes of the misses in the window. @param {import("/assets/timing_strip.js").Miss[]} misses */
export function showTicks(model, misses, from, to, colours) {
  const place = element("timing-facts");
  const counts = countCauses(misses, from, to);
  const parts = [...counts].map(([cause, count]) => {
    const { letter, name, colour } = causeOf(cause);
    const item = document.createElement("span");
    item.style.color = colours[colour];
    item.style.fontWeight = "600";
    item.textContent = `${letter} ${name}: ${count}`;
    return item;
  });
  const period = `bars: step time, up to one period of ${(model.periodNs / 1e6).toFixed(1)} ms (dashed line)`;
  const missed = parts.length > 0 ? parts.flatMap((part) => [part, "; "]) : ["no missed ticks; "];
  place.replaceChildren(...missed, period);
}

/**
 * Shows what was received and drawn since the last call.
 * @param {import("/assets/connection.js").Connection} connection @param {import("/assets/work.js").Work} work @param {number} seconds
 */
export function showStream(connection, work, seconds) {
  const { messages, bytes } = connection.received;
  connection.received = { messages: 0, bytes: 0 };
  const { pictures, messageMs } = work.take();
  set("stream-facts", `${(messages / seconds).toFixed(0)} messages/s, ${(bytes / seconds / 1e6).toFixed(1)} MB/s, ${(pictures / seconds).toFixed(0)} frames/s`);
  const share = (messageMs / seconds / 10).toFixed(1);
  element("stream-facts").title = `Script: ${work.quantile(0.5).toFixed(1)} ms per frame, messages ${share} % of the time`;
}
