// Fields of a running session over time, from the received messages.

import { layoutOf, reader } from "/assets/schema.js";
import { Series } from "/assets/series.js";
import { keyOf } from "/assets/log_series.js";

/** Messages that describe a tick but arrive later contain its number. */
const TICK_TOPICS = /^\/(timing\/|event|command\/)/;

/** Keeps the plotted fields, each at the messages' full rate. */
export class LiveSeries {
  constructor() {
    /** @type {Map<string, {name: import("/assets/log_series.js").FieldName, series: Series}>} */
    this.fields = new Map();
    /** Readers by channel schema. */
    this.readers = new Map();
  }

  clear() {
    for (const { series } of this.fields.values()) series.clear();
  }

  /** Keeps only these fields. @param {import("/assets/log_series.js").FieldName[]} names */
  keep(names) {
    const wanted = new Map(names.map((name) => [keyOf(name), name]));
    for (const key of this.fields.keys()) if (!wanted.has(key)) this.fields.delete(key);
    for (const [key, name] of wanted) if (!this.fields.has(key)) this.fields.set(key, { name, series: new Series(1) });
    this.readers.clear();
  }

  /** The topics of the fields. */
  get topics() {
    return new Set([...this.fields.values()].map(({ name }) => name.topic));
  }

  #readersOf(channel) {
    const known = this.readers.get(channel.topic);
    if (known?.schema === channel.schema) return known;
    const layout = layoutOf(channel.schema);
    const own = [...this.fields.values()].filter(({ name }) => name.topic === channel.topic);
    const readers = own.map(({ name, series }) => ({ series, read: reader(layout, name.field) })).filter(({ read }) => read);
    const made = { schema: channel.schema, readers, tick: TICK_TOPICS.test(channel.topic) ? reader(layout, "tick") : undefined };
    this.readers.set(channel.topic, made);
    return made;
  }

  /** @param {DataView} data @param {number} timeNs @param {import("/assets/connection.js").Channel} channel @param {number} periodNs */
  take(data, timeNs, channel, periodNs) {
    const { readers, tick } = this.#readersOf(channel);
    if (readers.length === 0) return;
    const time = (tick ? tick(data) * periodNs : timeNs) / 1e9;
    for (const { series, read } of readers) series.push(time, read(data));
  }

  /** @param {import("/assets/log_series.js").FieldName} name @returns {import("/assets/plot.js").Samples} */
  field(name) {
    const series = this.fields.get(keyOf(name))?.series;
    return {
      spacing: 0,
      each: (from, to, columns, draw) => series?.decimate(0, from, to, columns, (column, low, high, mean) => draw(from + ((column + 0.5) / columns) * (to - from), low, high, mean)),
      at: (time) => series?.at(0, time),
      last: () => series?.last(0),
    };
  }
}
