// Fields of a log over time, decimated by the server: minimum, maximum and mean of each column of a span.

/** Extra span requested on each side, as a fraction of the shown span. */
const MARGIN_SPANS = 0.5;
const MOST_COLUMNS = 4096;
/** Delay before repeating a request while the server is still reading the log. */
const AGAIN_MS = 250;

/**
 * @typedef {{topic: string, field: string}} FieldName
 * @typedef {{at: number[], low: number[], high: number[], mean: number[], width_ns: number}} Columns
 * @typedef {{from: number, to: number, columns: number, reading: number | null, fields: Map<string, Columns>,
 *   misses: {at: number[], letters: string, count: number[]}}} Span  times in seconds
 */

/** @param {FieldName} name */
export const keyOf = ({ topic, field }) => `${topic} ${field}`;

/** The series received for one log; requests what is to be drawn but missing. */
export class LogSeries {
  /**
   * @param {(request: object) => Promise<any>} ask calls `/series`
   * @param {() => void} changed
   * @param {boolean} second whether it is the second log
   */
  constructor(ask, changed, second) {
    this.ask = ask;
    this.changed = changed;
    this.second = second;
    this.clear();
  }

  /** Clears everything, for a new connection. */
  clear() {
    /** @type {Span | undefined} */
    this.span = undefined;
    this.asking = false;
    this.refused = undefined;
    /** Replies to requests sent before this belong to another log. */
    this.generation = (this.generation ?? 0) + 1;
  }

  /** Whether the loaded data is sufficient to draw this span. */
  #serves(fields, from, to, columns) {
    const { span } = this;
    if (!span || span.from > from || span.to < to) return false;
    const finer = (span.columns * (to - from)) / (span.to - span.from) >= columns * 0.9;
    return finer && fields.every((name) => span.fields.has(keyOf(name)));
  }

  /**
   * Requests fields over a span if they are missing; one request at a time.
   * @param {FieldName[]} fields @param {number} from seconds @param {number} to seconds @param {number} columns on the screen
   * @param {number} end of the log, seconds
   */
  want(fields, from, to, columns, end) {
    const stale = this.span?.reading != null && performance.now() - this.askedAt > AGAIN_MS;
    const key = fields.map(keyOf).join();
    if (this.asking || (!stale && this.#serves(fields, from, to, columns))) return;
    if (this.refused === key && performance.now() - this.askedAt < 2000) return;
    // A margin on both sides, so that a drag has something to show before the reply.
    const margin = (to - from) * MARGIN_SPANS;
    const [first, last] = [Math.max(0, from - margin), Math.min(Math.max(end, to), to + margin)];
    const wanted = Math.min(MOST_COLUMNS, Math.ceil((columns * (last - first)) / (to - from)));
    this.asking = true;
    this.askedAt = performance.now();
    const { generation } = this;
    const request = { fields, from_ns: Math.floor(first * 1e9), to_ns: Math.ceil(last * 1e9), columns: Math.max(1, wanted), second: this.second };
    this.ask(request).then((answer) => {
      if (generation !== this.generation) return;
      this.asking = false;
      this.tookMs = performance.now() - this.askedAt;
      this.refused = answer.ok ? undefined : key;
      this.error = answer.ok ? undefined : answer.error;
      if (answer.ok) this.#take(fields, answer);
      this.changed();
    });
  }

  #take(fields, { from_ns, to_ns, columns, reading, series, misses }) {
    const kept = new Map(fields.map((name, i) => [keyOf(name), series[i]]));
    this.span = { from: from_ns / 1e9, to: to_ns / 1e9, columns, reading, fields: kept, misses };
    // The rest of the log is fetched by further requests.
    if (reading != null) setTimeout(this.changed, AGAIN_MS + 20);
  }

  /** Whether the server is still reading the shown data. */
  get reading() {
    return this.span?.reading ?? undefined;
  }

  /** Returns a field's samples for drawing. @param {FieldName} name @returns {import("/assets/plot.js").Samples} */
  field(name) {
    return new LogField(this, keyOf(name));
  }
}

/** One field of a log, in the form that a plot expects. */
class LogField {
  /** @param {LogSeries} series @param {string} key */
  constructor(series, key) {
    this.series = series;
    this.key = key;
  }

  /** Samples farther apart than this, in seconds, have a gap between them. */
  get spacing() {
    const columns = this.series.span?.fields.get(this.key);
    return columns ? columns.width_ns / 1e9 : 0;
  }

  /** @type {import("/assets/plot.js").Samples["each"]} */
  each(from, to, _columns, draw) {
    const { span } = this.series;
    const columns = span?.fields.get(this.key);
    if (!columns) return;
    const wide = (span.to - span.from) / span.columns;
    for (let i = 0; i < columns.at.length; i++) {
      const time = span.from + columns.at[i] * wide;
      if (time + wide < from || time > to || columns.low[i] === null) continue;
      draw(time, columns.low[i], columns.high[i], columns.mean[i]);
    }
  }

  /** Mean of the column at or just before a time, or undefined. */
  at(time) {
    const { span } = this.series;
    const columns = span?.fields.get(this.key);
    if (!columns || time < span.from || time > span.to) return undefined;
    const column = ((time - span.from) / (span.to - span.from)) * span.columns;
    let [low, high] = [0, columns.at.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (columns.at[middle] <= column) low = middle + 1;
      else high = middle;
    }
    return low > 0 ? columns.mean[low - 1] : undefined;
  }
}
