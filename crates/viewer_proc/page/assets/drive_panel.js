// Switches and sliders of the drive panel.

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);

/** @param {import("/assets/drive.js").Drive} drive */
export function connectDrivePanel(drive) {
  element("tendon").addEventListener("input", (event) => drive.set({ tendonN: Number(event.target.value) }));
  element("feed").addEventListener("input", (event) => drive.set({ feedMmPerS: Number(event.target.value) }));
  element("burr").addEventListener("input", (event) => drive.set({ burrRpm: Number(event.target.value) }));
  for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("button[data-hold]"))) {
    const direction = button.dataset.hold === "insert" ? 1 : -1;
    const hold = (on) => drive.on && drive.set({ feedHeld: on ? direction : 0 });
    const isPress = (event) => event.key === " " || event.key === "Enter";
    button.addEventListener("pointerdown", () => hold(true));
    for (const end of ["pointerup", "pointerleave", "pointercancel", "blur"]) button.addEventListener(end, () => hold(false));
    button.addEventListener("keydown", (event) => isPress(event) && !event.repeat && hold(true));
    button.addEventListener("keyup", (event) => isPress(event) && hold(false));
  }
  window.addEventListener("gamepadconnected", (event) => (element("gamepad").textContent = `gamepad: ${event.gamepad.id.slice(0, 28)}`));
  window.addEventListener("gamepaddisconnected", () => (element("gamepad").textContent = ""));
}

/** @param {import("/assets/drive.js").Drive} drive @param {string} facts further text */
export function showDrive(drive, facts) {
  const drives = (part) => drive.on && drive.parts.includes(part);
  element("drive-switch").textContent = drive.on ? "Release control" : "Take control";
  element("drive-switch").setAttribute("aria-pressed", String(drive.on));
  element("drive-facts").textContent = facts;
  const tendon = element("tendon");
  tendon.max = String(drive.tendonMostN);
  if (document.activeElement !== tendon || drive.tendonHeld !== 0) tendon.value = String(drive.tendonN);
  tendon.disabled = !drives("tendon");
  for (const id of ["insert", "retract", "feed"]) element(id).disabled = !drives("arm");
  for (const id of ["burr", "burr-switch"]) element(id).disabled = !drives("burr");
  element("insert").classList.toggle("on", drive.feedHeld > 0);
  element("retract").classList.toggle("on", drive.feedHeld < 0);
  element("burr-switch").setAttribute("aria-pressed", String(drive.burrOn));
  element("burr-switch").textContent = drive.burrOn ? "Burr: on" : "Burr: off";
  element("tendon-facts").textContent = `${drive.tendonN.toFixed(1)} N`;
  element("feed-facts").textContent = `${drive.feedMmPerS.toFixed(1)} mm/s`;
  element("burr-facts").textContent = `${drive.burrRpm} rpm`;
}
