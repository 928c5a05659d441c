// Display of a field's numbers: the unit is the suffix of its name, as in every message.

const DEGREES = 180 / Math.PI;

/** Suffix of the name, displayed unit, factor. The first match applies. @type {[RegExp, string, number][]} */
const UNITS = [
  [/burr_speed\w*_rad_per_s$/, "rpm", 60 / (2 * Math.PI)],
  [/_rad_per_s$/, "°/s", DEGREES],
  [/_m_per_s$/, "mm/s", 1e3],
  [/_rad$/, "°", DEGREES],
  [/_n_m$/, "N mm", 1e3],
  [/_ns$/, "µs", 1e-3],
  [/_mm$/, "mm", 1],
  [/_m$/, "mm", 1e3],
  [/_n$/, "N", 1],
  [/_s$/, "s", 1],
];

/** @param {string} path such as `t_world_burr.position_m[2]` @returns {{unit: string, scale: number}} */
export function unitOf(path) {
  const name = path.replace(/\[\d+\]/g, "");
  const found = UNITS.find(([end]) => end.test(name));
  return found ? { unit: found[1], scale: found[2] } : { unit: "", scale: 1 };
}

/** Formats a field's name for a heading: its words, without the unit. @param {string} path */
export function labelOf(path) {
  const words = path.split(".").map((part) => part.replace(/_(rad_per_s|m_per_s|rad|n_m|ns|mm|m|n|s)(?=\[|$)/, "").replace(/_/g, " "));
  return words.join(", ");
}

/** Formats a number: two decimals if small, scientific notation if tiny or huge; never a negative zero. */
export function written(value) {
  const size = Math.abs(value);
  if (size >= 1e7 || (size > 0 && size < 0.005)) return value.toPrecision(3);
  return size >= 100 ? value.toFixed(0) : value.toFixed(2);
}
