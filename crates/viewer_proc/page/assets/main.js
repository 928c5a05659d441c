// The page: connects, passes messages to the model, and draws when something has changed.

import { Actions } from "/assets/actions.js";
import { showClearances } from "/assets/clearance.js";
import { Connection, GOES_ON, json } from "/assets/connection.js";
import { Cursor } from "/assets/cursor.js";
import { Drive } from "/assets/drive.js";
import { connectDrivePanel, showDrive } from "/assets/drive_panel.js";
import { commands } from "/assets/commands.js";
import { showGuidance } from "/assets/guidance.js";
import { CLICK_PX, Measures } from "/assets/measure.js";
import { Model } from "/assets/model.js";
import { Notices } from "/assets/notices.js";
import { drawGizmo, fillLegend, showScaleBar } from "/assets/overlays.js";
import { Rate, showFrame, showRun, showStream, showTicks, silence } from "/assets/panels.js";
import { PlanEdit } from "/assets/plan_edit.js";
import { showPlan } from "/assets/plan_view.js";
import { drawProfile } from "/assets/profile.js";
import { Film } from "/assets/figure.js";
import { PanelLayout } from "/assets/panel_layout.js";
import { PlotsPanel, STEP_TIME } from "/assets/plots_panel.js";
import { SceneView } from "/assets/scene_view.js";
import { SceneOverlay } from "/assets/scene_overlay.js";
import { fillSigns } from "/assets/signs.js";
import { sliceCommands } from "/assets/slice_commands.js";
import { Slices } from "/assets/slices.js";
import { Structures } from "/assets/structures.js";
import { endParts, showComparison, showParts } from "/assets/tables.js";
import { Theme } from "/assets/theme.js";
import { TimeLine } from "/assets/time_line.js";
import { drawTimingStrip } from "/assets/timing_strip.js";
import { Work } from "/assets/work.js";
import { XRay, decodeImage } from "/assets/x_ray.js";
import { XRayOverlay } from "/assets/x_ray_overlay.js";

/** Update period of the readouts, slow enough to be readable. */
const TEXT_MS = 100;
/** How long panels wait for a picture that is rendered in software. */
const PANELS_WAIT_MS = 400;
const READ_ONLY = "Read-only: to control the run, open the page with the address that the program printed (it ends in #token=…).";

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
const address = new URLSearchParams(location.hash.slice(1));
const token = address.get("token") ?? undefined;

const notices = new Notices(element("notices"), element("banner"));
const model = new Model();
const connection = new Connection(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${token ? `?token=${token}` : ""}`, token);
const dirty = { scene: true, slices: true, xRay: false, plots: true, profile: false };
const page = { model, connection, notices, work: new Work(), asked: 0 };
connection.took = (milliseconds) => page.work.message(milliseconds);
let scheduled = false;
/** When the page was last drawn. */
let drawn = 0;
let connected = false;
/** Last notice from the viewer: once it has gone, probably the reason. @type {string | undefined} */
let said;

/** Requests a redraw of one part, or of everything. @param {"scene" | "slices" | "xRay" | "plots"} [what] */
function changed(what) {
  if (what) dirty[what] = true;
  else Object.assign(dirty, { scene: true, slices: true, xRay: true, plots: true, profile: true });
  if (scheduled || !page.theme) return;
  scheduled = true;
  requestAnimationFrame(draw);
}
page.changed = changed;

/** Calls a service and shows the error if it is refused. */
page.call = async (service, request) => {
  if (!token) {
    notices.add("warning", READ_ONLY);
    return { ok: false, error: READ_ONLY };
  }
  const answer = await connection.call(service, request);
  if (!answer.ok) notices.add("error", `${service}: ${answer.error ?? "refused"}`);
  return answer;
};

page.xRay = new XRay(element("x-ray-canvas"), () => changed("xRay"));
page.xRay.listen();
page.cursor = new Cursor(() => changed());
page.measures = new Measures(() => (showMeasures(), changed()));
page.structures = new Structures(model, () => showStructures());
page.xRayOverlay = new XRayOverlay(element("x-ray-overlay"), page.xRay, model, page.cursor, page.measures);
page.xRayOverlay.structures = page.structures;
page.planEdit = new PlanEdit((request) => (token ? connection.call("/plan", request) : Promise.resolve({ ok: false, error: READ_ONLY })), () => (changed("scene"), changed("slices")), page.cursor);
// Slices need no control token: any client that can watch can see them.
page.slices = new Slices(model, page.cursor, page.measures, (request) => connection.call("/slice", request), () => changed("slices"));
page.slices.edit = page.planEdit;
page.slices.structures = page.structures;
page.plots = new PlotsPanel(element("plots-grid"), model, {
  changed: () => changed("plots"),
  ask: (request) => connection.call("/series", request),
  subscribe: (topics) => connection.also(topics),
  channels: () => connection.channels.values(),
  seek: (seconds) => page.call("/playback", { action: "seek", time_ns: Math.max(0, Math.round(seconds * 1e9)) }),
});
page.panels = new PanelLayout(() => changed());
page.film = new Film();
connection.each = (data, timeNs, channel) => model.info?.kind !== "log" && page.plots.live.take(data, timeNs, channel, model.periodNs);
page.timeLine = new TimeLine((request) => page.call("/playback", request), () => changed("plots"));
for (const dialog of document.querySelectorAll("dialog")) {
  // A button of a closed dialog keeps the focus until the next frame and would take the keys.
  dialog.addEventListener("close", () => dialog.contains(document.activeElement) && /** @type {HTMLElement} */ (document.activeElement).blur());
}
const refused = (text) => notices.add("error", `/drive: ${text}`);
page.drive = new Drive((request) => connection.call("/drive", request), () => showDriveNow(), refused, () => page.actions.run("pause"));
connectDrivePanel(page.drive);
try {
  page.view = new SceneView(element("scene-canvas"), () => changed("scene"));
  Object.assign(page.view, { cursor: page.cursor, measures: page.measures, structures: page.structures });
  page.sceneOverlay = new SceneOverlay(element("scene-overlay"), page.view, page.measures, page.planEdit);
  page.planEdit.listenToView(page.view, (point) => page.sceneOverlay.pixelOf(point));
  listenToClicks(element("scene-canvas"));
  const lost = "The browser has lost the 3D graphics context: reload the page.";
  element("scene-canvas").addEventListener("webglcontextlost", () => notices.show("webgl", lost));
} catch (error) {
  notices.show("webgl", `No 3D view: ${error instanceof Error ? error.message : error}. X-ray, plots and controls still work.`);
}
page.theme = new Theme(() => changed());
fillSigns();
page.actions = new Actions([...commands(page), ...sliceCommands(page)]);
page.actions.listen();
/** The selected speed as run control expects it: a real-time run has its own speed without stepping. */
page.speed = () => (model.info?.scene?.mode === "realtime" && element("speed").value === "1" ? 0 : Number(element("speed").value));
element("speed").addEventListener("change", () => page.call("/control", { action: "speed", speed: page.speed() }));
new ResizeObserver(() => changed()).observe(document.body);

/** In the 3D view a click measures, a double click places the cross-hair, and a drag rotates. @param
 * {HTMLCanvasElement} canvas */
function listenToClicks(canvas) {
  let travelled = 0;
  const place = (event) => page.view.placeAt(event.offsetX, event.offsetY, model);
  canvas.addEventListener("pointerdown", () => (travelled = 0));
  canvas.addEventListener("pointermove", (event) => (travelled += Math.abs(event.movementX) + Math.abs(event.movementY)));
  canvas.addEventListener("click", (event) => page.measures.on && travelled < CLICK_PX && page.measures.add(place(event)));
  canvas.addEventListener("dblclick", (event) => !page.measures.on && page.cursor.place(place(event)));
}

function showMeasures() {
  const { measures } = page;
  element("measure").setAttribute("aria-pressed", String(measures.on));
  element("measure-facts").textContent = measures.text;
  element("measure-clear").hidden = measures.lines.length === 0;
  document.body.classList.toggle("measuring", measures.on);
}

function showStructures() {
  element("structures-switch").hidden = page.structures.meshes.size === 0;
  element("structures-switch").setAttribute("aria-pressed", String(page.structures.on));
  takeLegend(document.body.classList.contains("compare"));
  changed();
}

function showDriveNow() {
  const named = model.info?.controllers?.includes("viewer") ?? false;
  const read = token ? "" : "Read-only: this address has no control token.";
  const none = named ? "" : "The scene has no controller named `viewer`.";
  showDrive(page.drive, read || none || (page.drive.on ? "W S feed, A D tendon, Q burr." : `Drives ${page.drive.parts.join(", ")}.`));
  element("drive-switch").disabled = !token || !named;
}

function takeInfo(data) {
  model.takeInfo(data);
  const { info } = model;
  document.body.classList.toggle("live", info.kind === "live");
  document.body.classList.toggle("log", info.kind === "log");
  if (document.title === "Trabecula") showSpeeds(info.scene?.mode);
  document.title = `${info.scene?.name ?? "Trabecula"} · Trabecula`;
  if (info.drives) page.drive.parts = info.drives;
  if (info.tool?.tendon_max_n) page.drive.tendonMostN = info.tool.tendon_max_n;
  page.xRay.denseIsBright = info.c_arm?.display === "bone_bright";
  if (info.c_arm) {
    element("c-arm-primary").value = String(info.c_arm.primary_angle_deg);
    element("c-arm-secondary").value = String(info.c_arm.secondary_angle_deg);
  }
  takeLegend(document.body.classList.contains("compare"));
  page.slices.takeInfo();
  page.planEdit.takeInfo(info);
  showPlan(info);
  dirty.profile = true;
  showDriveNow();
  changed();
}

/** Shows the speeds that a run can have: in real time none above its own. @param {string | undefined} mode */
function showSpeeds(mode) {
  const list = element("speed");
  for (const option of list.options) option.disabled = option.hidden = mode === "realtime" && !(Number(option.value) > 0 && Number(option.value) <= 1);
  list.value = mode === "lockstep" ? "0" : "1";
}

/** Takes the speed limit of the run, set by this page or another. */
function takePace(data) {
  model.pace = json(data).speed ?? undefined;
  const option = [...element("speed").options].find((one) => Number(one.value) === model.pace);
  if (option) option.selected = true;
  showTexts();
}

/** Holds a frame that this page requested until live frames are requested. */
function takeAskedFrame(data, _timeNs, channel) {
  if (!page.asked) return;
  page.asked -= 1;
  const { frame, end } = model.readFrame(data, channel);
  model.heldFrame = frame;
  page.xRay.hold(decodeImage(data, end));
  changed("xRay");
}

function takePlayback(data) {
  const playback = json(data);
  page.timeLine.take(playback);
  page.plots.axis.log = [playback.begin_ns / 1e9, playback.end_ns / 1e9];
  page.plots.axis.move(playback.time_ns / 1e9);
  if (playback.events) listMarks(playback.events);
  const two = !!page.timeLine.state.second;
  if (two !== document.body.classList.contains("compare")) {
    document.body.classList.toggle("compare", two);
    takeLegend(two);
  }
  changed("plots");
}

/** Lists the log's marks once. Misses are shown on the strip. */
function listMarks(marks) {
  const listed = marks.filter(({ kind }) => kind !== "miss").slice(-100);
  element("notices").querySelectorAll(".mark").forEach((item) => item.remove());
  for (const { kind, time_ns, text } of listed) {
    notices.add(kind === "note" ? "info" : "warning", `${(time_ns / 1e9).toFixed(3)} s: ${text}`);
    element("notices").firstElementChild.classList.add("mark");
  }
}

function takeLegend(second) {
  const scene = model.info?.scene;
  fillLegend(element("legend"), { planned: !!scene?.planned_path_m, target: !!scene?.target_m, margins: scene?.structures?.length > 0, structures: page.structures.all, second });
}

function takeNotice({ level, text }) {
  said = text;
  notices.add(level, text);
  if (text === "the run has ended") endParts();
  if (level === "error") notices.show("notice", text);
}

function takeState(data, timeNs, channel) {
  model.takeState(data, timeNs, channel);
  if (model.info?.kind !== "log") page.plots.axis.move(model.time ?? 0);
  changed("scene");
  changed("slices");
  changed("plots");
}

for (const prefix of ["", "/second"]) {
  for (const topic of ["/state", "/view/state"]) connection.on(`${prefix}${topic}`, takeState);
  connection.on(`${prefix}/drr/image`, (data) => page.xRay.take(decodeImage(data), prefix !== ""));
}
for (const topic of ["/sensor", "/view/sensor"]) connection.on(topic, (...message) => (model.takeReading(...message), changed("scene")));
connection.on("/view/miss", (data) => (model.takeMiss(data), changed("plots")));
connection.on("/drr/frame", (...message) => (model.takeFrame(...message), changed("xRay")));
connection.on("/view/frame_state", (...message) => (model.takeFrameState(...message), changed("xRay")));
connection.on("/view/asked_frame", takeAskedFrame);
connection.on("/view/pace", takePace);
connection.on("/run/status", (...message) => (model.takeStatus(...message), changed("plots")));
connection.on("/event", (...message) => {
  const { level, text } = model.event(...message);
  notices.add(level, text);
});
connection.on("/view/info", takeInfo);
// A picture rendered in software takes as long as its surface has triangles.
const isCoarse = (address.get("surface") ?? (page.view?.software ? "coarse" : "fine")) === "coarse";
connection.on(isCoarse ? "/view/surface_coarse" : "/view/surface", (data) => (page.view?.surface.update(data), changed("scene")));
connection.on("/view/arm", (data) => (page.view?.arm.update(data), changed("scene")));
connection.on("/view/structures", (data) => (page.view?.structureMeshes.update(data), page.structures.take(data)));
connection.on("/view/parts", (data) => showParts(json(data)));
connection.on("/view/playback", takePlayback);
connection.on("/view/notice", (data) => takeNotice(json(data)));
connection.on("/view/compare", (data) => showComparison(json(data)));

connection.addEventListener("open", () => {
  connected = true;
  model.clear();
  model.hasEnded = false;
  page.plots.clear();
  page.view?.surface.clear();
  page.view?.arm.clear();
  page.view?.structureMeshes.clear();
  page.structures.clear();
  page.asked = 0;
  page.xRay.hold(undefined);
  said = undefined;
  element("notices").replaceChildren();
  notices.show("connection");
  notices.show("notice");
  changed();
});
connection.addEventListener("close", (/** @type {CustomEvent} */ { detail }) => {
  // The same address is about to show something else: the run of a plan, or the log of a run.
  if (detail === GOES_ON) {
    connected = false;
    model.hasEnded = model.info?.kind === "live";
    notices.show("connection", model.hasEnded ? "The run has ended. Opening its log…" : "The run is starting…", "info");
    return showTexts();
  }
  // A run that ends closes the connection: this is not an error, and the last state stays on screen.
  model.hasEnded ||= model.info?.kind === "live" && (model.statusPhase === "ended" || said === "the run has ended");
  if (model.hasEnded) endParts();
  if (connected && !model.hasEnded) notices.add("error", `Connection to the viewer lost${detail ? `: ${detail}` : "."}`);
  connected = false;
  if (page.drive.on) page.drive.toggle(0);
  const why = [detail || "it has ended or has not started yet", said].filter(Boolean).join("; ");
  if (model.hasEnded) notices.show("connection", "The run has ended. This page keeps its last state; `trabecula view FOLDER` shows the log on a time line.", "info");
  else notices.show("connection", `Not connected to the viewer: ${why}. Reconnecting…`);
  showTexts();
});
connection.addEventListener("status", (/** @type {CustomEvent} */ { detail }) => notices.add(detail.level >= 2 ? "error" : detail.level === 1 ? "warning" : "info", detail.message));

function draw() {
  scheduled = false;
  const began = performance.now();
  const { colours } = page.theme;
  const waits = dirty.scene && page.view?.busy;
  // A processor that renders the scene renders the panels, too: they wait for each other.
  if (waits && page.view.software && began - Math.max(page.view.begun, drawn) < PANELS_WAIT_MS) return changed("scene");
  drawn = began;
  const idle = waits && !dirty.slices && !dirty.xRay && !dirty.plots;
  if (dirty.scene && page.view && !waits) drawScene(colours);
  if (dirty.slices) page.slices.draw();
  if (dirty.xRay) {
    page.xRay.draw();
    page.xRayOverlay.draw();
  }
  if (dirty.plots) {
    page.plots.draw(colours);
    drawTimingStrip(element("timing-canvas"), page.plots.samples(STEP_TIME), page.plots.misses(), page.plots.times(), model.periodNs, colours);
    if (model.info?.kind === "log") page.timeLine.draw(colours);
  }
  if (dirty.profile && model.info?.plan?.profile) drawProfile(element("plan-profile"), model.info.plan, colours);
  Object.assign(dirty, { scene: false, slices: false, xRay: false, plots: false, profile: false });
  if (waits) changed("scene");
  if (!idle) page.work.picture(performance.now() - began);
}

function drawScene(colours) {
  const { view } = page;
  view.dark = page.theme.dark;
  view.draw(model);
  page.sceneOverlay.draw();
  drawGizmo(element("gizmo"), view.camera.view, colours);
  showScaleBar(element("scale-bar"), view.camera.metresPerPixel(view.canvas.clientHeight));
}

const rate = new Rate();
let streamShown = performance.now();

function showTexts() {
  const now = performance.now();
  showRun(model, connected, page.timeLine.state, rate.add(model.info?.kind === "log" ? page.timeLine.state.time_ns / 1e9 : model.time, now));
  showFrame(model, page.xRay);
  showGuidance(model);
  showClearances(model.clearances);
  const [from, to] = page.plots.range();
  showTicks(model, page.plots.misses(), from, to, page.theme.colours);
  const { reading } = page.plots;
  element("plots-facts").textContent = reading === undefined ? "" : `reading the log: ${Math.floor(reading * 100)} %`;
  page.plots.showValues(page.theme.colours);
  notices.show("silence", silence(model, connected, now), "warning");
  if (now - streamShown >= 1000) {
    showStream(connection, page.work, (now - streamShown) / 1000);
    streamShown = now;
  }
}

setInterval(showTexts, TEXT_MS);
connection.open();
changed();

/** For tests and the browser's console: the page's objects, to read. */
Object.assign(window, { trabecula: page });
