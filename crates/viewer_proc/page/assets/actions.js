// The page's actions in one table, from which buttons, keys and help are built.

/**
 * @typedef {{id: string, group: string, keys: string[], text: string, run: () => void, when?: () => boolean, held?: () => void}} Action
 * `held`: called when the key is released; such an action lasts as long as the key is down.
 */

/** A key's name as shown to the user. */
const spelled = (key) => ({ " ": "Space", ArrowUp: "↑", ArrowDown: "↓", ArrowLeft: "←", ArrowRight: "→" })[key] ?? (key.length === 1 ? key.toUpperCase() : key);

/** Whether the focus is on an element that uses the keys itself. */
function typing(target) {
  if (target instanceof HTMLInputElement) return target.type !== "range";
  return target instanceof HTMLSelectElement || target instanceof HTMLTextAreaElement;
}

export class Actions {
  /** @param {Action[]} actions */
  constructor(actions) {
    this.actions = actions;
    this.byId = new Map(actions.map((action) => [action.id, action]));
    /** @type {Map<string, Action>} */
    this.byKey = new Map();
    for (const action of actions) {
      for (const key of action.keys.map((key) => key.toLowerCase())) {
        if (this.byKey.has(key)) console.error(`key ${key}: both ${this.byKey.get(key).id} and ${action.id}`);
        this.byKey.set(key, action);
      }
    }
    this.down = new Map();
  }

  run(id) {
    const action = this.byId.get(id);
    if (action && (action.when?.() ?? true)) action.run();
  }

  /** Buttons with `data-action`, and the keys of the whole page. */
  listen() {
    for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("button[data-action]"))) {
      const action = this.byId.get(button.dataset.action);
      button.addEventListener("click", () => this.run(action.id));
      if (action.keys.length > 0) {
        button.setAttribute("aria-keyshortcuts", action.keys.map(spelled).join(" "));
        button.title = `${action.text} (${action.keys.map(spelled).join(", ")})`;
      }
    }
    document.addEventListener("keydown", (event) => this.#keyDown(event));
    document.addEventListener("keyup", (event) => this.#release(event.key.toLowerCase()));
    window.addEventListener("blur", () => [...this.down.keys()].forEach((key) => this.#release(key)));
  }

  #keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target) || document.querySelector("dialog[open]")) return;
    // Space and Enter press the focused button.
    if ((event.key === " " || event.key === "Enter") && event.target instanceof HTMLButtonElement) return;
    const key = event.key.toLowerCase();
    const action = this.byKey.get(key);
    if (!action || !(action.when?.() ?? true)) return;
    event.preventDefault();
    if (action.held && (event.repeat || this.down.has(key))) return;
    if (action.held) this.down.set(key, action);
    action.run();
  }

  #release(key) {
    this.down.get(key)?.held();
    this.down.delete(key);
  }

  /** Fills the help with the actions available now. @param {HTMLElement} place */
  fillHelp(place) {
    place.replaceChildren();
    for (const group of new Set(this.actions.map((action) => action.group))) {
      const list = document.createElement("dl");
      for (const action of this.actions.filter((one) => one.group === group && one.keys.length > 0 && (one.when?.() ?? true))) {
        const term = list.appendChild(document.createElement("dt"));
        action.keys.forEach((key) => (term.appendChild(document.createElement("kbd")).textContent = spelled(key)));
        list.appendChild(document.createElement("dd")).textContent = action.text;
      }
      if (list.children.length === 0) continue;
      const section = place.appendChild(document.createElement("section"));
      section.appendChild(document.createElement("h3")).textContent = group;
      section.appendChild(list);
    }
  }
}
