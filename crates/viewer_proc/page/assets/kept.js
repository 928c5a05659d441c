// Browser storage for the page between visits. Without storage (a private window, a full disk) the page uses
// its defaults.

const PREFIX = "trabecula.";

/** @param {string} name @returns {any} undefined if missing or unreadable */
export function stored(name) {
  try {
    return JSON.parse(localStorage.getItem(PREFIX + name) ?? "null") ?? undefined;
  } catch {
    return undefined;
  }
}

/** @param {string} name @param {any} value undefined deletes it */
export function store(name, value) {
  try {
    if (value === undefined) localStorage.removeItem(PREFIX + name);
    else localStorage.setItem(PREFIX + name, JSON.stringify(value));
  } catch {
    // The page works without storage.
  }
}
