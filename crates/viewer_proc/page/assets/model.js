// State from the server's messages, for the panels.

import { layoutOf, reader } from "/assets/schema.js";
import { armFrames } from "/assets/arm.js";
import { FrameStates } from "/assets/frame_states.js";
import { Trail, contactsOf } from "/assets/tool_model.js";
import { json } from "/assets/connection.js";

const MAX_ARM_JOINTS = 7;
const LINKS = 32;
const BODIES = 4;
const CONTACTS = 40;
const STRUCTURES = 16;
const PHASES = ["connecting", "running", "paused", "ended"];

/** Kind of the readings of clearances. */
const CLEARANCE = 6;

/** Maximum number of misses kept. */
const MOST_MISSES = 20000;

const many = (layout, path, count) => Array.from({ length: count }, (_, i) => reader(layout, `${path}[${i}]`));
const three = (layout, path) => many(layout, path, 3);
const poseReader = (layout, path) => ({
  position: three(layout, `${path}.position_m`),
  rotation: [0, 1, 2, 3].map((i) => reader(layout, `${path}.orientation_xyzw[${i}]`)),
});
const readPose = (at, view) => ({ position: at.position.map((f) => f(view)), rotation: at.rotation.map((f) => f(view)) });

/** Readers for the fields of a state. @param {import("/assets/schema.js").Layout} layout */
function stateReaders(layout) {
  return {
    tick: reader(layout, "tick"), removed: reader(layout, "removed_total"),
    layout, tension: reader(layout, "tendon_tension_n[0]"), force: reader(layout, "burr_force_n"), burr: three(layout, "t_world_burr.position_m"),
    linkCount: reader(layout, "joint_count"), base: poseReader(layout, "t_world_base"), burrPose: poseReader(layout, "t_world_burr"),
    links: Array.from({ length: LINKS }, (_, i) => poseReader(layout, `t_world_link[${i}]`)), flange: poseReader(layout, "t_world_flange"),
    armAngles: Array.from({ length: MAX_ARM_JOINTS }, (_, i) => reader(layout, `arm_joint_position_rad[${i}]`)),
    bodyCount: reader(layout, "body_count"), contactCount: reader(layout, "contact_count"),
    bodies: Array.from({ length: BODIES }, (_, i) => poseReader(layout, `t_world_body[${i}]`)),
    contacts: Array.from({ length: CONTACTS }, (_, i) => ({
      point: three(layout, `contacts[${i}].point_m`), normal: three(layout, `contacts[${i}].normal`),
      normalForce: reader(layout, `contacts[${i}].normal_force_n`), friction: three(layout, `contacts[${i}].friction_force_n`),
    })),
  };
}

/**
 * Returns the poses of arm and tool in a state.
 * @param {any} info of `/view/info` @returns {import("/assets/tool_model.js").Poses}
 */
function posesOf(read, state, info) {
  const flange = readPose(read.flange, state);
  const links = read.links.slice(0, read.linkCount(state)).map((at) => readPose(at, state));
  const arm = armFrames(flange, read.armAngles.map((f) => f(state)), info?.arm?.parts ?? []);
  return { arm, flange, base: readPose(read.base, state), links, burr: readPose(read.burrPose, state) };
}

/** Returns the string that follows a struct. @param {DataView} data @param {number} at */
function tailText(data, at) {
  const size = data.getUint32(at, true);
  return new TextDecoder().decode(new Uint8Array(data.buffer, data.byteOffset + at + 4, Math.max(0, size - 1)));
}

export class Model {
  constructor() {
    this.readers = new Map();
    this.info = undefined;
    this.frameStates = new FrameStates();
    this.trail = new Trail();
    /** Simulated time of the newest state, seconds. @type {number | undefined} */
    this.time = undefined;
    /** Late ticks of a run in order, with the letter of the cause. @type {import("/assets/timing_strip.js").Miss[]} */
    this.misses = [];
    this.statusPhase = "connecting";
    /** Speed limit of the run, enforced by stepping while paused; undefined: no limit. */
    this.pace = undefined;
    this.status = undefined;
    this.frame = undefined;
    /** Clearances in metres, in the scene's order. @type {number[] | undefined} */
    this.distances = undefined;
    /** Whether the run has ended, so that a closed connection is not an error. */
    this.hasEnded = false;
    /** Wall-clock time of the last state. */
    this.stateAt = undefined;
  }

  /** Returns the readers for a channel's schema, created once. */
  #read(channel, make) {
    const known = this.readers.get(channel.topic);
    if (known?.schema === channel.schema) return known.readers;
    const layout = layoutOf(channel.schema);
    const readers = make(layout);
    this.readers.set(channel.topic, { schema: channel.schema, readers });
    return readers;
  }

  get contacts() {
    return this.state ? contactsOf(this.stateRead, this.state) : [];
  }

  get poses() {
    return this.state && posesOf(this.stateRead, this.state, this.info);
  }

  /** Centre of the burr. @returns {import("/assets/vector.js").Vector | undefined} */
  get tip() {
    return this.state && this.stateRead.burr.map((f) => f(this.state));
  }

  /** Returns the tool's poses at a tick, or at the nearest one within `most` ticks. @param {number} tick @param {number} most */
  posesAt(tick, most) {
    const state = this.frameStates.near(tick, most);
    return state && posesOf(this.stateRead, state, this.info);
  }

  /** Same for the second log. */
  get second() {
    return this.secondState && posesOf(this.stateRead, this.secondState, this.info);
  }

  get bodies() {
    if (!this.state) return [];
    return this.stateRead.bodies.slice(0, this.stateRead.bodyCount(this.state)).map((at) => readPose(at, this.state));
  }

  get tick() {
    return this.state ? this.stateRead.tick(this.state) : undefined;
  }

  get removed() {
    return this.state ? this.stateRead.removed(this.state) : undefined;
  }

  /** @type {import("/assets/connection.js").Handler} */
  takeState(data, timeNs, channel) {
    const read = this.#read(channel, stateReaders);
    const second = channel.topic.startsWith("/second");
    this.stateRead = read;
    if (!second) this.frameStates.add(read.tick(data), data);
    if (second) {
      this.secondState = data;
      return;
    }
    this.state = data;
    this.time = timeNs / 1e9;
    this.stateAt = performance.now();
    this.trail.add(read.burr.map((f) => f(data)), timeNs);
  }

  /** Takes a sensor reading, if it is one of clearances. @type {import("/assets/connection.js").Handler} */
  takeReading(data, _timeNs, channel) {
    // Each structure has two values: its clearance, and the index of the tool's closest sphere.
    const read = this.#read(channel, (layout) => ({ kind: reader(layout, "kind"), values: many(layout, "value", 2 * STRUCTURES) }));
    if (read.kind(data) === CLEARANCE) this.distances = read.values.filter((_, i) => i % 2 === 0).map((f) => f(data));
  }

  /** Structures of the scene with the tool's clearance from them. @returns {import("/assets/clearance.js").Clearance[]} */
  get clearances() {
    return (this.info?.scene?.structures ?? []).map((structure, i) => ({ ...structure, clearance_m: this.distances?.[i] }));
  }

  /** Takes the state at the time of the shown frame (logs only). @type {import("/assets/connection.js").Handler} */
  takeFrameState(data, _timeNs, channel) {
    this.stateRead ??= this.#read(channel, stateReaders);
    this.frameStates.add(this.stateRead.tick(data), data);
  }

  /** Takes a late tick with its cause; earlier ones arrive together when the page connects. @param {DataView} data */
  takeMiss(data) {
    const { tick, letter } = json(data);
    const time = (tick * this.periodNs) / 1e9;
    // They are sent again after the viewer's connection is reset.
    if (this.misses.length > 0 && time <= this.misses[this.misses.length - 1].time) return;
    this.misses.push({ time, letter, count: 1 });
    if (this.misses.length > MOST_MISSES) this.misses.splice(0, MOST_MISSES / 2);
  }

  /** Returns a field of the newest state; undefined for other topics. @param {import("/assets/log_series.js").FieldName} name @param {boolean} second */
  field({ topic, field }, second) {
    const state = second ? this.secondState : this.state;
    if (topic !== "/state" || !state) return undefined;
    return reader(this.stateRead.layout, field)?.(state);
  }

  /** Tension of the first tendon, N. */
  get tension() {
    return this.state ? this.stateRead.tension(this.state) : undefined;
  }

  /** Force on the burr, N. */
  get force() {
    return this.state ? this.stateRead.force(this.state) : undefined;
  }

  get periodNs() {
    return this.info?.scene?.dt_ns ?? 1e6;
  }

  /** @type {import("/assets/connection.js").Handler} */
  takeStatus(data, _timeNs, channel) {
    const read = this.#read(channel, (layout) => {
      return Object.fromEntries(["tick", "tick_count", "missed_ticks", "phase", "mode"].map((name) => [name, reader(layout, name)]));
    });
    this.status = Object.fromEntries(Object.entries(read).map(([name, f]) => [name, f(data)]));
    this.statusPhase = PHASES[this.status.phase] ?? "connecting";
  }

  /** The run's phase; a run with a speed limit counts as running. */
  get phase() {
    return this.statusPhase === "paused" && this.pace ? "running" : this.statusPhase;
  }

  /** @type {import("/assets/connection.js").Handler} */
  takeFrame(data, _timeNs, channel) {
    this.frame = this.readFrame(data, channel).frame;
  }

  /** Reads a `Frame`; returns its facts and where it ends. */
  readFrame(data, channel) {
    const read = this.#read(channel, (layout) => ({
      sequence: reader(layout, "sequence"), tick: reader(layout, "tick"),
      primary: reader(layout, "projection.primary_angle_rad"), secondary: reader(layout, "projection.secondary_angle_rad"), end: layout.bytes,
      projection: { intrinsics: many(layout, "projection.intrinsics", 9), rotation: many(layout, "projection.rotation", 9), translation: three(layout, "projection.translation_m") },
    }));
    const { end, projection, ...fields } = read;
    const values = (readers) => Object.fromEntries(Object.entries(readers).map(([name, f]) => [name, f(data)]));
    const matrices = Object.fromEntries(Object.entries(projection).map(([name, all]) => [name, all.map((f) => f(data))]));
    return { frame: { ...values(fields), projection: matrices }, end };
  }

  /**
   * Returns an `Event` as level and text.
   * @param {DataView} data @param {number} _timeNs @param {import("/assets/connection.js").Channel} channel
   * @returns {{level: "info" | "warning" | "error", text: string}}
   */
  event(data, _timeNs, channel) {
    const read = this.#read(channel, (layout) => ({
      severity: reader(layout, "severity"), tick: reader(layout, "tick"), end: layout.bytes,
    }));
    /** @type {["info", "warning", "error"]} */
    const levels = ["info", "warning", "error"];
    return { level: levels[read.severity(data)] ?? "error", text: `tick ${read.tick(data)}: ${tailText(data, read.end)}` };
  }

  /** @param {DataView} data */
  takeInfo(data) {
    this.info = json(data);
  }

  /** Clears everything that belongs to a run, for a new connection. */
  clear() {
    this.trail.clear();
    this.frameStates.clear();
    this.misses = [];
    this.time = this.status = undefined;
    this.distances = undefined;
    this.state = this.secondState = this.frame = this.heldFrame = this.stateAt = this.pace = undefined;
  }
}

