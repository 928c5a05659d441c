// The tables: connected parts, and the differences between two logs.

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

function row(cells) {
  const line = document.createElement("tr");
  cells.forEach((text, column) => {
    const cell = line.appendChild(document.createElement("td"));
    // A field name wraps between its words, not within them; a number does not wrap.
    const parts = column === 0 ? text.split(/(?<=[_.])/) : [text];
    parts.forEach((part, i) => cell.append(...(i > 0 ? [document.createElement("wbr"), part] : [part])));
  });
  return line;
}

const rate = (hz) => (hz == null ? "–" : hz >= 100 ? `${hz.toFixed(0)} Hz` : `${hz.toFixed(1)} Hz`);
const age = (ms) => (ms == null ? "–" : ms < 1000 ? `${ms.toFixed(0)} ms` : `${(ms / 1000).toFixed(1)} s`);
/** Formats a number with at most six significant digits. */
export const short = (value) => (typeof value === "number" ? Number(value.toPrecision(6)).toString() : String(value ?? "–"));

/** @param {{name: string, rate_hz: number, age_ms: number, state: string}[]} parts */
export function showParts(parts) {
  element("parts").replaceChildren(...parts.map((part) => row([part.name, rate(part.rate_hz), age(part.age_ms), part.state ?? ""])));
}

/** Marks all parts as inactive after the end of the run. */
export function endParts() {
  for (const state of document.querySelectorAll("#parts td:last-child")) state.textContent = "ended";
}

/** @param {{time_ns: number, ended?: string, end_ns?: number, fields: {name: string, a: number, b: number, difference: number}[]}} comparison */
export function showComparison({ time_ns, ended, end_ns, fields }) {
  if (ended) {
    element("compare-facts").textContent = `at ${(time_ns / 1e9).toFixed(3)} s`;
    element("compare-rows").replaceChildren(row([`the ${ended} log has ended at ${(end_ns / 1e9).toFixed(3)} s`, "", "", ""]));
    return;
  }
  element("compare-facts").textContent = `${fields.length} fields at ${(time_ns / 1e9).toFixed(3)} s`;
  const rows = fields.map(({ name, a, b, difference }) => row([name, short(a), short(b), short(difference)]));
  if (rows.length === 0) rows.push(row(["no field of the state differs", "", "", ""]));
  element("compare-rows").replaceChildren(...rows);
}
