// What letters, dashed lines and crosses mean, panel by panel.

import { CAUSES } from "/assets/timing_strip.js";
import { COLOURS } from "/assets/tool_model.js";

/** @param {import("/assets/parts_list.js").Colour} colour */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;
/** A line as it is drawn, as a sign. */
const line = (colour, shape) => ({ colour, shape });
const PLANNED = css(COLOURS.planned);
const TARGET = css(COLOURS.target);
const CROSS_HAIR = css(COLOURS.cursor);

/** Where the signs stand, and what each means: letters in a colour, or a shape. @type {Record<string, [string | {colour: string, shape: string}, string, string?][]>} */
const SIGNS = {
  "slice-signs": [
    [line(PLANNED, "solid"), "planned path in the slice"], [line(PLANNED, "dashed"), "planned path in front of the slice or behind it"],
    [{ colour: TARGET, shape: "cross" }, "target; faint: not in the slice"], [{ colour: CROSS_HAIR, shape: "cross" }, "cross-hair, one place in all pictures"],
    [line(css(COLOURS.linkOdd), "solid"), "outline of the tool"], [line(css(COLOURS.burr), "solid"), "outline of the burr"],
    [{ colour: "rgb(178 128 20)", shape: "box" }, "drilled away"], [{ colour: "rgb(92 98 106)", shape: "box" }, "outside of the CT"],
    ["L R", "patient's left, right"], ["A P", "front (anterior), back (posterior)"], ["H F", "head, feet"],
  ],
  "x-ray-signs": [
    [line(PLANNED, "dashed"), "planned path"], [{ colour: TARGET, shape: "cross" }, "target"], [{ colour: CROSS_HAIR, shape: "cross" }, "cross-hair"],
    [line(css(COLOURS.linkOdd), "solid"), "middle of the tool at the frame"], [{ colour: css(COLOURS.burr), shape: "ring" }, "burr at the frame"],
  ],
  "plot-signs": [
    [line("currentColor", "solid"), "mean; the pale band: least to greatest value"], [line("currentColor", "dashed"), "the same of the second log"],
  ],
  "tick-signs": [
    [line("currentColor", "dashed"), "one period: a taller step makes a late tick"],
    ...CAUSES.map(({ letter, name, colour }) => /** @type {[string, string, string]} */ ([letter, name, `var(${colour})`])),
  ],
};

/** Fills the legends of all panels. */
export function fillSigns() {
  for (const [id, signs] of Object.entries(SIGNS)) {
    const list = document.getElementById(id);
    list.classList.add("signs");
    list.replaceChildren(...signs.flatMap(([sign, text, colour]) => {
      const term = document.createElement("dt");
      if (typeof sign === "string") Object.assign(term, { textContent: sign }).style.color = colour ?? "inherit";
      else Object.assign(term.appendChild(document.createElement("span")), { className: `sign ${sign.shape}` }).style.color = sign.colour;
      return [term, Object.assign(document.createElement("dd"), { textContent: text })];
    }));
  }
}
