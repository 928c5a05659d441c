// The list of all message fields, to search, click, and drag into a plot.

import { layoutOf } from "/assets/schema.js";

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
/** Maximum number of fields listed, because thousands would be slow; a search finds the others. */
const MOST_SHOWN = 200;

export class FieldPicker {
  /**
   * @param {() => Iterable<import("/assets/connection.js").Channel>} channels
   * @param {(plot: number | undefined, name: import("/assets/log_series.js").FieldName) => void} chosen `plot`: undefined for a new one
   */
  constructor(channels, chosen) {
    this.channels = channels;
    this.chosen = chosen;
    /** @type {import("/assets/log_series.js").FieldName | undefined} */
    this.dragged = undefined;
    element("field-search").addEventListener("input", () => this.#list());
    element("fields-close").addEventListener("click", () => (element("fields").hidden = true));
    element("fields").addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      element("fields").hidden = true;
      event.stopPropagation();
    });
  }

  /** Opens the list for a plot, or for a new one. @param {number} [plot] */
  open(plot) {
    this.plot = plot;
    element("fields").hidden = false;
    element("fields-title").textContent = plot === undefined ? "Field for a new plot" : "Field for this plot";
    this.#list();
    element("field-search").focus();
  }

  /** Returns all plottable fields. @returns {import("/assets/log_series.js").FieldName[]} */
  all() {
    const logged = [...this.channels()].filter(({ encoding, topic }) => encoding === "cdr" && !topic.startsWith("/second") && !topic.startsWith("/view/"));
    return logged.flatMap(({ topic, schema }) => [...layoutOf(schema).fields.keys()].map((field) => ({ topic, field })));
  }

  #list() {
    const words = element("field-search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = this.all().filter(({ topic, field }) => words.every((word) => `${topic} ${field}`.toLowerCase().includes(word)));
    const items = found.slice(0, MOST_SHOWN).map((name) => {
      const item = document.createElement("li");
      const button = item.appendChild(document.createElement("button"));
      button.textContent = `${name.topic} ${name.field}`;
      button.draggable = true;
      button.addEventListener("click", () => this.chosen(this.plot, name));
      button.addEventListener("dragstart", (event) => {
        this.dragged = name;
        event.dataTransfer.setData("text/plain", button.textContent);
      });
      button.addEventListener("dragend", () => (this.dragged = undefined));
      return item;
    });
    element("field-list").replaceChildren(...items);
    const more = found.length - items.length;
    element("field-count").textContent = more > 0 ? `${found.length} fields; search to find ${more} more` : `${found.length} fields`;
  }
}
