// The tool's clearance from critical structures: a table, and the colour of the tool within a margin.

import { COLOURS } from "/assets/tool_model.js";

/** @typedef {{name: string, margin_m: number, is_target: boolean, clearance_m: number | undefined}} Clearance */

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
const millimetres = (metres) => `${(metres * 1e3).toFixed(2)} mm`;

/** Returns what is left of the margin, 0 to 1: 1 outside of it and for a target, 0 inside the structure.
 * @param {Clearance} clearance */
function marginLeft({ margin_m, is_target, clearance_m }) {
  if (is_target || clearance_m === undefined || clearance_m >= margin_m) return 1;
  return Math.max(0, clearance_m) / (margin_m || 1);
}

/** Returns the colour of the tool within a margin, from amber at its edge to red in the structure; undefined outside of
 * all margins. @param {Clearance[]} clearances @returns {import("/assets/parts_list.js").Colour | undefined} */
export function toolColour(clearances) {
  const left = Math.min(1, ...clearances.map(marginLeft));
  if (left === 1) return undefined;
  const [r, g, b] = COLOURS.breach.map((part, i) => part + left * (COLOURS.margin[i] - part));
  return [r, g, b, 1];
}

/** @param {Clearance[]} clearances in the scene's order */
export function showClearances(clearances) {
  element("clearances").hidden = clearances.length === 0;
  const rows = element("clearance-rows");
  while (rows.rows.length > clearances.length) rows.deleteRow(-1);
  clearances.forEach((clearance, i) => {
    const row = rows.rows[i] ?? rows.insertRow();
    const { name, margin_m, is_target, clearance_m } = clearance;
    const left = marginLeft(clearance);
    row.className = left === 1 ? "" : left > 0 ? "warning" : "error";
    const cells = [name, clearance_m === undefined ? "–" : millimetres(clearance_m), is_target ? "target" : millimetres(margin_m)];
    cells.forEach((text, column) => {
      const cell = row.cells[column] ?? row.insertCell();
      if (cell.textContent !== text) cell.textContent = text;
    });
  });
}
