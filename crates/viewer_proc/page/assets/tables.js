// The tables: connected parts, and the difference of two logs.

/** The element of `index.html`, whose kind the page's author knows. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

function row(cells) {
  const line = document.createElement("tr");
  cells.forEach((text, column) => {
    const cell = line.appendChild(document.createElement("td"));
    // A field's name breaks between its words, not within them; a number does not break.
    const parts = column === 0 ? text.split(/(?<=[_.])/) : [text];
    parts.forEach((part, i) => cell.append(...(i > 0 ? [document.createElement("wbr"), part] : [part])));
  });
  return line;
}

const rate = (hz) => (hz == null ? "–" : hz >= 100 ? `${hz.toFixed(0)} Hz` : `${hz.toFixed(1)} Hz`);
const age = (ms) => (ms == null ? "–" : ms < 1000 ? `${ms.toFixed(0)} ms` : `${(ms / 1000).toFixed(1)} s`);
/** A number with at most six digits that say something. */
export const short = (value) => (typeof value === "number" ? Number(value.toPrecision(6)).toString() : String(value ?? "–"));

/** @param {{name: string, rate_hz: number, age_ms: number, state: string}[]} parts */
export function showParts(parts) {
  element("parts").replaceChildren(...parts.map((part) => row([part.name, rate(part.rate_hz), age(part.age_ms), part.state ?? ""])));
}

/** After the end of the run none of its parts is active. */
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
