// Light or dark theme: the system's setting until the user chooses one.

const KEY = "trabecula-theme";
const system = window.matchMedia("(prefers-color-scheme: dark)");

/** The user's choice, if storage is available. */
function chosen() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}

export class Theme {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    system.addEventListener("change", () => this.#apply());
    this.#apply();
  }

  get dark() {
    return document.documentElement.dataset.theme === "dark";
  }

  toggle() {
    const other = this.dark ? "light" : "dark";
    try {
      localStorage.setItem(KEY, other);
    } catch {
      // Without storage the choice lasts until the page is closed.
    }
    this.#apply(other);
  }

  #apply(theme = chosen() ?? (system.matches ? "dark" : "light")) {
    document.documentElement.dataset.theme = theme;
    const style = getComputedStyle(document.documentElement);
    const names = ["panel", "text", "muted", "grid", "accent", "error", "series-1", "series-2", "series-3", "series-4", "cause-step", "cause-core", "cause-fault", "cause-host"];
    /** Colours for canvases, by custom property. @type {Record<string, string>} */
    this.colours = Object.fromEntries(names.map((name) => [`--${name}`, style.getPropertyValue(`--${name}`).trim()]));
    this.changed();
  }
}
