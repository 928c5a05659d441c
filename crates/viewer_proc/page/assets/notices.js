// Messages for the user: a list that screen readers follow, and a banner for what must not be missed.

const KEPT = 200;
const NUMBERS = /[+-]?\d+(\.\d+)?/g;
const WORDS = { info: "note", warning: "warning", error: "error" };

export class Notices {
  /** @param {HTMLElement} list @param {HTMLElement} banner */
  constructor(list, banner) {
    this.list = list;
    this.banner = banner;
    /** Banners by subject, the newest last. @type {Map<string, {level: string, text: string}>} */
    this.banners = new Map();
  }

  /** Adds a message on top. A message that repeats the last one, or a note that differs from an earlier one
   * only in its numbers, replaces it and is counted: a note with every frame would hide the rest.
   * @param {"info" | "warning" | "error"} level @param {string} text */
  add(level, text) {
    const key = level === "info" ? text.replace(NUMBERS, "#") : text;
    const items = /** @type {HTMLElement[]} */ ([...this.list.children]);
    const earlier = level === "info" ? items.find((item) => item.dataset.key === key) : items.slice(0, 1).find((item) => item.dataset.key === key);
    const count = Number(earlier?.dataset.count ?? 0) + 1;
    earlier?.remove();
    const item = document.createElement("li");
    Object.assign(item.dataset, { key, count });
    const word = item.appendChild(document.createElement("span"));
    word.className = `level ${level}`;
    word.textContent = WORDS[level] ?? level;
    item.append(count > 1 ? `${text} × ${count}` : text);
    this.list.prepend(item);
    while (this.list.children.length > KEPT) this.list.lastElementChild.remove();
  }

  /** Shows a banner, or removes it if there is no text. @param {string} about @param {string} [text]
   * @param {"info" | "warning" | "error"} [level] */
  show(about, text, level = "error") {
    if (this.banners.get(about)?.text === text) return;
    this.banners.delete(about);
    if (text) this.banners.set(about, { level, text });
    const all = [...this.banners.values()];
    this.banner.hidden = all.length === 0;
    this.banner.className = ["error", "warning"].find((level) => all.some((one) => one.level === level)) ?? "info";
    this.banner.replaceChildren(...all.map((one) => Object.assign(document.createElement("p"), { textContent: one.text })));
  }
}
