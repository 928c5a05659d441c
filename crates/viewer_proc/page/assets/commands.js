// The actions of the page's keys and buttons, by name.

import { VIEWS } from "/assets/camera.js";
import { fileName, plotsCsv, plotsPng, plotsSvg, save } from "/assets/figure.js";

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
const C_ARM_STEP_DEG = 5;

/** Asks for confirmation of something that cannot be undone. @param {string} question @param {() => void}
 * act */
function confirmed(question, act) {
  const dialog = element("confirm");
  element("confirm-text").textContent = question;
  dialog.returnValue = "";
  dialog.onclose = () => dialog.returnValue === "yes" && act();
  dialog.showModal();
}

/**
 * @param {object} page connection, model, view, xRay, plots, drive, timeLine, theme, call, changed
 * @returns {import("/assets/actions.js").Action[]}
 */
export function commands(page) {
  const { model, view, xRay, plots, drive, timeLine } = page;
  const isLog = () => model.info?.kind === "log";
  const isLive = () => model.info?.kind === "live";
  const drawn = () => !!view;
  const driving = () => isLive() && drive.on;
  const control = (request) => page.call("/control", request);
  const playback = (request) => page.call("/playback", request);

  const step = (ticks) => (isLog() ? playback({ action: "step", ticks }) : control({ action: "step", ticks }));
  const changeSpeed = (direction) => {
    if (isLog()) return timeLine.changeSpeed(direction);
    const list = element("speed");
    list.selectedIndex = Math.max(0, Math.min(list.options.length - 1, list.selectedIndex + direction));
    list.dispatchEvent(new Event("change"));
  };
  const pause = () => {
    if (isLog()) timeLine.togglePlay();
    else control(model.phase === "paused" ? { action: "speed", speed: page.speed() } : { action: "pause" });
  };
  const frame = async () => {
    const angle = (id) => Number(element(id).value);
    // The frame may arrive before the answer.
    page.asked += 1;
    const answer = await page.call("/frame", { primary_angle_deg: angle("c-arm-primary"), secondary_angle_deg: angle("c-arm-secondary") });
    if (!answer.ok) page.asked = Math.max(0, page.asked - 1);
  };
  const live = () => {
    page.asked = 0;
    xRay.hold(undefined);
  };
  const turnCArm = (id, direction) => {
    const input = element(id);
    input.value = String(Math.max(Number(input.min), Math.min(Number(input.max), Number(input.value) + direction * C_ARM_STEP_DEG)));
    frame();
  };
  const nextSource = () => {
    const sources = ["both", "first", "second", "difference"];
    xRay.shows = sources[(sources.indexOf(xRay.shows) + 1) % sources.length];
    page.changed();
  };
  const saved = {
    csv: () => save(new Blob([plotsCsv(plots)], { type: "text/csv" }), fileName(model.info?.scene?.name ?? "", "plots", "csv")),
    svg: () => save(new Blob([plotsSvg(plots, page.theme.colours)], { type: "image/svg+xml" }), fileName(model.info?.scene?.name ?? "", "plots", "svg")),
    png: async () => save(await plotsPng(plots, page.theme.colours), fileName(model.info?.scene?.name ?? "", "plots", "png")),
    // The browser clears the canvas after showing it, so it is drawn and captured at once.
    view: () => ((view.sharp = true), view.draw(model), view.canvas.toBlob((blob) => save(blob, fileName(model.info?.scene?.name ?? "", "view", "png")))),
  };
  const film = () => {
    const runs = page.film.toggle(view.canvas, fileName(model.info?.scene?.name ?? "", "view", "webm"));
    view.filmed = runs;
    element("film").textContent = runs ? "Stop the video" : "Video (WebM)";
  };
  const isPlan = () => model.info?.kind === "plan";
  const savePlan = () => {
    const dialog = element("plan-dialog");
    const name = element("plan-name");
    if (!name.value) name.value = `${(model.info?.path ?? "scene").split("/").at(-1).replace(/\.toml$/, "")}_edited.toml`;
    dialog.returnValue = "";
    dialog.onclose = () => dialog.returnValue === "save" && page.planEdit.save(name.value, confirmed);
    dialog.showModal();
    name.select();
  };
  const help = () => {
    page.actions.fillHelp(element("help-keys"));
    element("help").showModal();
  };
  const held = (what, direction) => ({ run: () => drive.set({ [what]: direction }), held: () => drive.set({ [what]: 0 }), when: driving });

  return [
    { id: "pause", group: "Run", keys: [" "], text: "pause, resume", run: pause },
    { id: "step", group: "Run", keys: ["."], text: "one tick", run: () => step(1) },
    { id: "step-many", group: "Run", keys: [">"], text: "100 ticks", run: () => step(100) },
    { id: "faster", group: "Run", keys: ["+", "="], text: "faster", run: () => changeSpeed(1) },
    { id: "slower", group: "Run", keys: ["-"], text: "slower", run: () => changeSpeed(-1) },
    { id: "reset", group: "Run", keys: ["r"], text: "reset", when: isLive,
      run: () => confirmed("Reset the simulation to its initial state? All drilled bone is restored.", () => control({ action: "reset" })) },
    { id: "stop", group: "Run", keys: ["x"], text: "stop the run", when: isLive,
      run: () => confirmed("Stop the run? Its logs are completed; it cannot be resumed.", () => control({ action: "stop" })) },

    { id: "step-back", group: "Log", keys: [","], text: "one tick back", when: isLog, run: () => playback({ action: "step", ticks: -1 }) },
    { id: "next-event", group: "Log", keys: ["n"], text: "next event", when: isLog, run: () => playback({ action: "next", kind: "event" }) },
    { id: "previous-event", group: "Log", keys: ["p"], text: "previous event", when: isLog, run: () => playback({ action: "previous", kind: "event" }) },
    { id: "next-miss", group: "Log", keys: ["m"], text: "next missed tick", when: isLog, run: () => playback({ action: "next", kind: "miss" }) },
    { id: "next-divergence", group: "Log", keys: ["g"], text: "next divergence", when: isLog, run: () => playback({ action: "next", kind: "divergence" }) },

    { id: "drive", group: "Drive", keys: ["e"], text: "take or release control", when: isLive, run: () => drive.toggle(model.tension ?? 0) },
    { id: "insert", group: "Drive", keys: ["w"], text: "insert (hold)", ...held("feedHeld", 1) },
    { id: "retract", group: "Drive", keys: ["s"], text: "retract (hold)", ...held("feedHeld", -1) },
    { id: "pull", group: "Drive", keys: ["d"], text: "pull the tendon (hold)", ...held("tendonHeld", 1) },
    { id: "release", group: "Drive", keys: ["a"], text: "slacken the tendon (hold)", ...held("tendonHeld", -1) },
    { id: "burr", group: "Drive", keys: ["q"], text: "burr on, off", when: driving, run: () => drive.set({ burrOn: !drive.burrOn }) },

    { id: "plan-save", group: "Plan", keys: [], text: "save the plan as a scene", when: isPlan, run: savePlan },
    { id: "plan-restore", group: "Plan", keys: [], text: "undo all moves", when: isPlan, run: () => page.planEdit.restore() },
    { id: "plan-run", group: "Plan", keys: [], text: "run the scene", when: isPlan, run: () => page.planEdit.run() },

    { id: "primary-up", group: "C-arm", keys: ["l"], text: "rotate to the patient's left", when: isLive, run: () => turnCArm("c-arm-primary", 1) },
    { id: "primary-down", group: "C-arm", keys: ["j"], text: "rotate to the right", when: isLive, run: () => turnCArm("c-arm-primary", -1) },
    { id: "secondary-up", group: "C-arm", keys: ["i"], text: "rotate to the head", when: isLive, run: () => turnCArm("c-arm-secondary", 1) },
    { id: "secondary-down", group: "C-arm", keys: ["k"], text: "rotate to the feet", when: isLive, run: () => turnCArm("c-arm-secondary", -1) },
    { id: "frame", group: "C-arm", keys: ["f"], text: "take a frame and hold it", when: isLive, run: frame },
    { id: "x-ray-live", group: "C-arm", keys: ["y"], text: "back to the live frames", when: () => !!xRay.held, run: live },

    { id: "view-front", group: "View", keys: ["1"], text: "from the front", when: drawn, run: () => view.camera.look(VIEWS.front) },
    { id: "view-side", group: "View", keys: ["2"], text: "from the patient's right", when: drawn, run: () => view.camera.look(VIEWS.side) },
    { id: "view-above", group: "View", keys: ["3"], text: "from the head", when: drawn, run: () => view.camera.look(VIEWS.above) },
    { id: "bone", group: "View", keys: ["b"], text: "bone: section, glass, solid, hidden", when: drawn,
      run: () => (element("bone-mode").textContent = `Bone: ${view.nextBoneMode()}`) },
    { id: "structures", group: "View", keys: ["5"], text: "show or hide the critical structures", when: () => page.structures.meshes.size > 0,
      run: () => page.structures.toggle() },
    { id: "longer", group: "View", keys: ["["], text: "longer time axis", run: () => plots.changeWindow(1) },
    { id: "whole", group: "View", keys: ["\\"], text: "reset the time axis: the last seconds, or the whole log", run: () => (plots.axis.reset(), page.changed()) },
    { id: "field", group: "View", keys: ["/"], text: "choose a field to plot", run: () => plots.picker.open() },
    { id: "shorter", group: "View", keys: ["]"], text: "shorter time axis", run: () => plots.changeWindow(-1) },
    { id: "save-csv", group: "View", keys: [], text: "plots as CSV", run: saved.csv },
    { id: "save-svg", group: "View", keys: [], text: "plots as SVG", run: saved.svg },
    { id: "save-png", group: "View", keys: [], text: "plots as PNG", run: saved.png },
    { id: "save-view", group: "View", keys: [], text: "3D view as PNG", when: drawn, run: saved.view },
    { id: "film", group: "View", keys: [], text: "video of the 3D view", when: drawn, run: film },
    { id: "restore", group: "View", keys: [], text: "reset plots and panels", run: () => (plots.restore(), page.panels.restore()) },
    { id: "theme", group: "View", keys: ["t"], text: "light or dark", run: () => page.theme.toggle() },
    { id: "help", group: "View", keys: ["?", "h"], text: "show this help", run: help },

    { id: "window-auto", group: "X-ray", keys: ["o"], text: "automatic window", run: () => xRay.automatic() },
    { id: "invert", group: "X-ray", keys: ["v"], text: "invert", run: () => xRay.invert() },
    { id: "x-ray-source", group: "X-ray", keys: ["c"], text: "both logs, first, second, difference", when: () => document.body.classList.contains("compare"), run: nextSource },
  ];
}
