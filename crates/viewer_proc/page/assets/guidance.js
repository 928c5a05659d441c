// Readouts for guidance: tip position, distance from target and plan, and burr force.

import { add, dot, length, scale, subtract } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

/** Returns the distance of a point from a polyline, metres. @param {Vector} point @param {Vector[]} line */
export function distanceFrom(point, line) {
  let nearest = Infinity;
  for (let i = 1; i < line.length; i++) {
    const way = subtract(line[i], line[i - 1]);
    const share = dot(subtract(point, line[i - 1]), way) / (dot(way, way) || 1);
    const foot = add(line[i - 1], scale(way, Math.max(0, Math.min(1, share))));
    nearest = Math.min(nearest, length(subtract(point, foot)));
  }
  return nearest;
}

/** Formats patient coordinates: left, posterior, superior, mm. @param {Vector} point metres */
export const placeText = (point) => point.map((x) => (x * 1e3).toFixed(1).replace(/^-(0\.0)$/, "$1")).join(", ");

function set(id, text) {
  const place = element(id);
  if (place.textContent !== text) place.textContent = text;
}

/** @param {import("/assets/model.js").Model} model */
export function showGuidance(model) {
  const tip = model.tip;
  const scene = model.info?.scene;
  const millimetres = (metres) => `${(metres * 1e3).toFixed(1)} mm`;
  set("tip", tip ? `${placeText(tip)} mm` : "–");
  set("to-target", tip && scene?.target_m ? millimetres(length(subtract(scene.target_m, tip))) : "–");
  set("off-plan", tip && scene?.planned_path_m ? millimetres(distanceFrom(tip, scene.planned_path_m)) : "–");
  const force = model.force;
  set("force", force === undefined ? "–" : `${force.toFixed(1)} N`);
}
