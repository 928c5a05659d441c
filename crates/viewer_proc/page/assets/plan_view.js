// A scene before its run: the tool at the end of its path, pilot holes, the C-arm's rays, and measurements.

import { placeText } from "/assets/guidance.js";
import { length, scale, subtract } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {import("/assets/parts_list.js").PartsList} PartsList */

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
/** Width of the C-arm's lines: barely visible from a metre away. */
const LINE_M = 0.0006;
/** The tool at the end of its path is translucent. @type {import("/assets/parts_list.js").Colour} */
const END = [1, 0.55, 0.24, 0.4];
/** The predicted tool and its path. @type {import("/assets/parts_list.js").Colour} */
const PREDICTED = [0, 0.78, 0.55, 0.45];
/** @type {import("/assets/parts_list.js").Colour} */
const HOLE = [0.34, 0.71, 0.91, 0.35];
/** @type {import("/assets/parts_list.js").Colour} */
const RAYS = [0.45, 0.5, 0.58, 1];

/** Adds the translucent parts. @param {PartsList} list @param {any} info of `/view/info` */
export function addPlannedTool(list, info) {
  const addTool = (tool, colour) => {
    for (let i = 1; i < tool.line_m.length; i++) list.cylinder(tool.line_m[i - 1], tool.line_m[i], tool.radius_m, colour);
    for (const ball of tool.burr) list.sphere(ball.centre_m, ball.radius_m, colour);
  };
  if (info?.plan?.tool_end) addTool(info.plan.tool_end, END);
  const predicted = info?.plan?.predicted;
  if (predicted) {
    addTool(predicted.tool_end, PREDICTED);
    list.path(predicted.path_m, LINE_M, PREDICTED);
  }
  if (info?.plan) for (const hole of info.scene?.predrill ?? []) list.cylinder(hole.from_m, hole.to_m, hole.radius_m, HOLE);
}

/** Adds source, detector, the rays to its corners, and the isocentre. @param {PartsList} list @param {any} info of `/view/info` */
export function addFrustum(list, info) {
  const frustum = info?.plan?.frustum;
  if (!frustum) return;
  const { source_m: source, detector_m: corners } = frustum;
  corners.forEach((corner, i) => {
    list.cylinder(source, corner, LINE_M, RAYS);
    list.cylinder(corner, corners[(i + 1) % corners.length], 2 * LINE_M, RAYS);
  });
  list.sphere(source, 8 * LINE_M, RAYS);
  if (info.c_arm) list.target(info.c_arm.isocentre_m, 0.005, RAYS);
}

/** Returns the radius of the circle through first, middle and last point of a bend, metres. @param {Vector[]} path @param {Vector} [start] earliest start of the bend */
export function bendRadius(path, start) {
  const from = start ? path.findIndex((point) => length(subtract(point, start)) < 1e-4) : 0;
  const bend = path.slice(Math.max(0, from));
  // Skips the straight part before the bend: points on the line of the first step.
  const direction = bend.length > 1 ? subtract(bend[1], bend[0]) : undefined;
  if (!direction) return undefined;
  const off = (point) => length(subtract(subtract(point, bend[0]), scale(direction, length(subtract(point, bend[0])) / length(direction))));
  const first = bend.findIndex((point) => off(point) > 1e-5);
  if (first < 1) return undefined;
  const [a, b, c] = [bend[first], bend[Math.floor((first + bend.length - 1) / 2)], bend.at(-1)];
  const [ab, bc, ca] = [length(subtract(b, a)), length(subtract(c, b)), length(subtract(a, c))];
  const half = (ab + bc + ca) / 2;
  const area = Math.sqrt(Math.max(0, half * (half - ab) * (half - bc) * (half - ca)));
  return area > 1e-12 ? (ab * bc * ca) / (4 * area) : undefined;
}

/** Adds what the simulation of the plan predicts. @param {(name: string, text: string) => void} row @param {any} prediction */
function addPrediction(row, prediction) {
  if (!prediction) return row("predicted", "simulating…");
  const millimetres = (value) => (value == null ? "–" : `${value.toFixed(2)} mm`);
  const peak = (force) => `${force.force_n.toFixed(1)} N at tick ${force.tick}`;
  const { tool, plan } = prediction;
  row("predicted", `${prediction.simulated_s.toFixed(1)} s, ${millimetres(tool?.target_error_mm)} off target, ${millimetres(plan.path_deviation_mm)} off the path`);
  row("least radius", `${millimetres(plan.least_radius_mm)}; possible ${millimetres(plan.possible_radius_mm)}`);
  row("largest forces", `burr ${peak(plan.forces.burr)}; walls ${peak(plan.forces.walls)}; flange ${peak(plan.forces.flange)}`);
  row("stops, breaches", `${plan.protective_stops}, ${prediction.breaches.length}`);
}

/** @param {any} info of `/view/info` */
export function showPlan(info) {
  const facts = info?.plan?.facts;
  document.body.classList.toggle("plan", info?.kind === "plan");
  const rows = [];
  const row = (name, text) => rows.push([name, text]);
  const millimetres = (value) => (value == null ? "–" : `${value.toFixed(1)} mm`);
  const place = (sample) => (sample ? `${placeText(scale(sample.place_mm, 1e-3))} mm, ${sample.hu == null ? "outside the CT" : `${sample.hu.toFixed(0)} HU`}` : "the path does not reach bone");
  if (facts) {
    row("entry", place(facts.entry));
    row("burr at the start", place(facts.burr_start));
    row(facts.is_planned ? "target" : "30 mm ahead", place(facts.target));
    row("path", `${millimetres(facts.path_mm)}, ${millimetres(facts.insertion_mm)} drilled, ${millimetres(facts.in_bone_mm)} in bone`);
    const radius = bendRadius(info.scene.planned_path_m ?? [], info.scene.burr_start_m);
    if (radius) row("bend radius", millimetres(radius * 1e3));
    if (facts.mean_hu != null) row("bone on the path", `${facts.least_hu.toFixed(0)} to ${facts.most_hu.toFixed(0)} HU, ${facts.mean_hu.toFixed(0)} on average`);
    row("target to outside", `${millimetres(facts.target_depth_mm)}; ${millimetres(facts.bone_ahead_mm)} of bone ahead`);
    row("arm travel", `${facts.arm_feed_mm.toFixed(0)} mm or more`);
  } else if (info?.kind === "plan") {
    row("CT", "none in the scene");
  }
  if (info?.kind === "plan") addPrediction(row, info.plan.prediction);
  element("plan-rows").replaceChildren(...rows.map(([name, text]) => {
    const line = document.createElement("tr");
    line.appendChild(document.createElement("th")).textContent = name;
    line.appendChild(document.createElement("td")).textContent = text;
    return line;
  }));
  const findings = facts?.findings ?? [];
  element("plan-facts").textContent = findings.length === 0 ? "no warnings" : `${findings.length} ${findings.length === 1 ? "warning" : "warnings"}`;
  element("plan-findings").replaceChildren(...findings.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  element("plan-profile").hidden = !info?.plan?.profile;
}

