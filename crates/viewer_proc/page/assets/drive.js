// Manual drive: the user's inputs for tendon, feed and burr, from keys, buttons, sliders and gamepad.

const SEND_MS = 50;
const TENDON_N_PER_S = 4;
/** Dead zone of a stick. */
const DEAD_ZONE = 0.12;
const RAD_PER_S_PER_RPM = (2 * Math.PI) / 60;

/** Returns the inputs of a standard gamepad, or undefined. @returns {{feed: number, tendon: number, burr: boolean, pause: boolean} | undefined} */
export function readGamepad() {
  const pad = [...navigator.getGamepads()].find((one) => one?.connected);
  if (!pad) return undefined;
  const axis = (i) => (Math.abs(pad.axes[i] ?? 0) < DEAD_ZONE ? 0 : pad.axes[i]);
  return { feed: -axis(1), tendon: -axis(3), burr: (pad.buttons[7]?.value ?? 0) > 0.3, pause: pad.buttons[0]?.pressed ?? false };
}

export class Drive {
  /**
   * @param {(request: object) => Promise<{ok: boolean, error?: string}>} send @param {() => void} changed
   * @param {(text: string) => void} refused @param {() => void} pause for the gamepad's button
   */
  constructor(send, changed, refused, pause) {
    this.send = send;
    this.changed = changed;
    this.refused = refused;
    this.pause = pause;
    /** The gamepad's button state at the last poll. @type {boolean | undefined} */
    this.padBurr = undefined;
    this.padPause = false;
    this.on = false;
    this.tendonN = 0;
    this.tendonMostN = 15;
    this.feedMmPerS = 1.5;
    this.burrRpm = 8000;
    this.burrOn = false;
    /** Held keys and buttons: -1, 0 or 1. */
    this.feedHeld = 0;
    this.tendonHeld = 0;
    this.parts = ["tendon", "arm", "burr"];
    this.lastSent = "";
  }

  /** Takes or releases control. @param {number} tensionN current tendon tension, so that it does not jump */
  toggle(tensionN) {
    this.on = !this.on;
    this.feedHeld = this.tendonHeld = 0;
    this.burrOn = false;
    if (this.on) {
      this.tendonN = Math.max(0, Math.min(this.tendonMostN, tensionN));
      this.lastSent = "";
      this.timer = setInterval(() => this.#tick(), SEND_MS);
    } else {
      this.#transmit(0);
      clearInterval(this.timer);
    }
    this.changed();
  }

  /** @param {Partial<Drive>} values */
  set(values) {
    Object.assign(this, values);
    if (this.on) this.#tick(0);
    this.changed();
  }

  #tick(seconds = SEND_MS / 1000) {
    const pad = readGamepad();
    const tendon = this.tendonHeld || (pad?.tendon ?? 0);
    this.tendonN = Math.max(0, Math.min(this.tendonMostN, this.tendonN + tendon * TENDON_N_PER_S * seconds));
    if (pad && pad.burr !== this.padBurr) [this.burrOn, this.padBurr] = [pad.burr, pad.burr];
    if (pad?.pause && !this.padPause) this.pause();
    this.padPause = pad?.pause ?? false;
    this.#transmit(this.feedHeld || (pad?.feed ?? 0));
    if (tendon !== 0 || pad) this.changed();
  }

  /** Sends on every change, and continuously while the tool moves: without requests the server stops it. */
  async #transmit(feed) {
    const request = {};
    if (this.parts.includes("tendon")) request.tendon_n = this.tendonN;
    if (this.parts.includes("arm")) request.insert_m_per_s = feed * this.feedMmPerS * 1e-3;
    if (this.parts.includes("burr")) request.burr_rad_per_s = this.burrOn ? this.burrRpm * RAD_PER_S_PER_RPM : 0;
    const text = JSON.stringify(request);
    if (text === this.lastSent && feed === 0) return;
    this.lastSent = text;
    const answer = await this.send(request);
    if (answer.ok || !this.on) return;
    this.on = false;
    clearInterval(this.timer);
    this.refused(answer.error ?? "the drive command was refused");
    this.changed();
  }
}
