// What the browser keeps of the page between visits. Without storage (a private window, a full disk) the page has its defaults.

const PREFIX = "trabecula.";

/** @param {string} name @returns {any} undefined if there is nothing, or nothing that can be read */
export function stored(name) {
  try {
    return JSON.parse(localStorage.getItem(PREFIX + name) ?? "null") ?? undefined;
  } catch {
    return undefined;
  }
}

/** @param {string} name @param {any} value undefined forgets it */
export function store(name, value) {
  try {
    if (value === undefined) localStorage.removeItem(PREFIX + name);
    else localStorage.setItem(PREFIX + name, JSON.stringify(value));
  } catch {
    // The page works without.
  }
}
