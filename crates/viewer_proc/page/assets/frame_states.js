// The states of the last seconds, by tick: a frame shows the tool as it was at that tick.

const KEPT = 1500;

export class FrameStates {
  constructor() {
    this.clear();
  }

  clear() {
    /** @type {Map<number, DataView>} */
    this.states = new Map();
  }

  /** @param {number} tick @param {DataView} state */
  add(tick, state) {
    this.states.delete(tick);
    this.states.set(tick, state);
    if (this.states.size > KEPT) this.states.delete(this.states.keys().next().value);
  }

  /** Returns the state of a tick, or the nearest one within `most` ticks. @param {number} tick @param {number} most @returns {DataView | undefined} */
  near(tick, most) {
    const exact = this.states.get(tick);
    if (exact) return exact;
    let [nearest, off] = [undefined, most + 1];
    for (const [other, state] of this.states) {
      if (Math.abs(other - tick) < off) [nearest, off] = [state, Math.abs(other - tick)];
    }
    return nearest;
  }
}
