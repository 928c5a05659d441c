// Messages for the user: a list that screen readers follow, and a banner for what must not be missed.

const KEPT = 200;
const WORDS = { info: "note", warning: "warning", error: "error" };

export class Notices {
  /** @param {HTMLElement} list @param {HTMLElement} banner */
  constructor(list, banner) {
    this.list = list;
    this.banner = banner;
    /** Banners by subject, the newest last. @type {Map<string, {level: string, text: string}>} */
    this.banners = new Map();
  }

  /** @param {"info" | "warning" | "error"} level @param {string} text */
  add(level, text) {
    const previous = /** @type {HTMLElement | null} */ (this.list.firstElementChild);
    if (previous?.dataset.text === text) {
      const count = Number(previous.dataset.count ?? 1) + 1;
      previous.dataset.count = String(count);
      previous.lastElementChild.textContent = ` × ${count}`;
      return;
    }
    const item = document.createElement("li");
    item.dataset.text = text;
    const word = item.appendChild(document.createElement("span"));
    word.className = `level ${level}`;
    word.textContent = WORDS[level] ?? level;
    item.append(text, document.createElement("span"));
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
