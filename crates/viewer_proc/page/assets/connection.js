// The Foxglove WebSocket protocol: channels, subscriptions and services of the viewer's server.

import { SOFTWARE } from "/assets/software.js";

const SUBPROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
const MESSAGE_DATA = 1;
const TIME = 2;
const SERVICE_RESPONSE = 3;
const SERVICE_REQUEST = 2;
const RETRY_MS = 1500;
/** Topics with a message per tick. A browser that renders in software gets only the newest, at most 30 times a second. */
const EACH_TICK = /^\/(state|sensor|latched|timing\/tick|command\/.*)$/;
/** Close reason when the same address will show something else next, and the delay before reconnecting. */
export const GOES_ON = "the viewer goes on";
const GOES_ON_MS = 50;

/**
 * @typedef {{id: number, topic: string, encoding: string, schemaName: string, schema: string}} Channel
 * @typedef {(data: DataView, timeNs: number, channel: Channel) => void} Handler
 */

/** One connection, reopened when it closes. Events: `open`, `close`, `status` (detail: the server's
 * message). */
export class Connection extends EventTarget {
  /** @param {string} url @param {string | undefined} token the control token; undefined: read-only */
  constructor(url, token) {
    super();
    this.url = url;
    this.token = token;
    /** @type {Map<string, Handler>} */
    this.handlers = new Map();
    this.received = { messages: 0, bytes: 0 };
    /** Called with the milliseconds that each message took. @type {(milliseconds: number) => void} */
    this.took = () => {};
    this.nextCall = 1;
    /** Topics to subscribe to in addition to those with a handler. @type {Set<string>} */
    this.more = new Set();
    /** Receives every message, in addition to its topic's handler. @type {Handler} */
    this.each = () => {};
    this.#forget();
  }

  #forget() {
    /** @type {Map<number, Channel>} */
    this.channels = new Map();
    this.subscriptions = new Map();
    this.services = new Map();
    for (const call of this.calls?.values() ?? []) call({ ok: false, error: "the connection closed" });
    this.calls = new Map();
  }

  /** Sets the handler for a topic's messages, also after reconnections. @param {string} topic @param
   * {Handler} handler */
  on(topic, handler) {
    this.handlers.set(topic, handler);
  }

  /** Subscribes to these topics in addition to those with a handler, and to no others. @param
   * {Set<string>} topics */
  also(topics) {
    this.more = topics;
    if (this.socket?.readyState === WebSocket.OPEN) this.#subscribe();
  }

  /** Whether to subscribe to a channel. Of a log's states and readings only those at its position are streamed; its
   * plots are requested (`log_series.js`). */
  #wants({ topic }) {
    const isLog = [...this.channels.values()].some((channel) => channel.topic === "/view/state");
    if (isLog && (topic === "/event" || topic === "/view/miss" || /^(\/second)?\/state$|^\/sensor$/.test(topic))) return false;
    return this.handlers.has(topic) || (!isLog && this.more.has(topic));
  }

  #subscribe() {
    const wanted = new Map([...this.channels].filter(([, channel]) => this.#wants(channel)));
    const gone = [...this.subscriptions.keys()].filter((id) => !wanted.has(id));
    // The channel's id serves as the subscription's id.
    const added = [...wanted.keys()].filter((id) => !this.subscriptions.has(id));
    this.subscriptions = wanted;
    if (gone.length > 0) this.#send({ op: "unsubscribe", subscriptionIds: gone });
    const subscription = (id) => ({ id, channelId: id, newest: SOFTWARE && EACH_TICK.test(wanted.get(id).topic) });
    if (added.length > 0) this.#send({ op: "subscribe", subscriptions: added.map(subscription) });
  }

  open() {
    this.socket = new WebSocket(this.url, SUBPROTOCOLS);
    this.socket.binaryType = "arraybuffer";
    this.socket.addEventListener("open", () => this.dispatchEvent(new Event("open")));
    this.socket.addEventListener("message", (event) => {
      const began = performance.now();
      this.#take(event.data);
      this.took(performance.now() - began);
    });
    this.socket.addEventListener("close", (event) => {
      this.#forget();
      this.dispatchEvent(new CustomEvent("close", { detail: event.reason }));
      setTimeout(() => this.open(), event.reason === GOES_ON ? GOES_ON_MS : RETRY_MS);
    });
  }

  /** @param {string | ArrayBuffer} data */
  #take(data) {
    if (typeof data === "string") return this.#takeText(JSON.parse(data));
    this.received.messages += 1;
    this.received.bytes += data.byteLength;
    const view = new DataView(data);
    const kind = view.getUint8(0);
    if (kind === MESSAGE_DATA) {
      const channel = this.subscriptions.get(view.getUint32(1, true));
      const handler = this.handlers.get(channel?.topic);
      if (!channel) return;
      const [body, timeNs] = [new DataView(data, 13), Number(view.getBigUint64(5, true))];
      this.each(body, timeNs, channel);
      handler?.(body, timeNs, channel);
    } else if (kind === SERVICE_RESPONSE) {
      const start = 13 + view.getUint32(9, true);
      const call = view.getUint32(5, true);
      const text = (from, bytes) => new TextDecoder().decode(new Uint8Array(data, from, bytes));
      // Anything other than JSON is passed on unchanged.
      const isJson = text(13, start - 13) === "json";
      this.calls.get(call)?.(isJson ? JSON.parse(text(start)) : { ok: true, bytes: new DataView(data, start) });
      this.calls.delete(call);
    } else if (kind !== TIME) {
      console.warn(`unknown binary message ${kind} of the server`);
    }
  }

  #takeText(message) {
    if (message.op === "advertise") {
      for (const channel of message.channels) this.channels.set(channel.id, channel);
      this.#subscribe();
    } else if (message.op === "unadvertise") {
      for (const id of message.channelIds) this.channels.delete(id), this.subscriptions.delete(id);
    } else if (message.op === "advertiseServices") {
      for (const service of message.services) this.services.set(service.name, service.id);
      this.dispatchEvent(new Event("services"));
    } else if (message.op === "status") {
      this.dispatchEvent(new CustomEvent("status", { detail: message }));
    } else if (message.op === "serviceCallFailure") {
      this.calls.get(message.callId)?.({ ok: false, error: message.message });
      this.calls.delete(message.callId);
    }
  }

  #send(message) {
    this.socket.send(JSON.stringify(message));
  }

  /**
   * Calls a service; never throws.
   * @param {string} name @param {object} request @returns {Promise<{ok: boolean, error?: string, bytes?: DataView, [more: string]: any}>}
   *   `bytes`: a reply that is not JSON
   */
  call(name, request) {
    if (this.socket?.readyState !== WebSocket.OPEN) return Promise.resolve({ ok: false, error: "not connected" });
    const service = this.services.get(name);
    if (service === undefined) return Promise.resolve({ ok: false, error: `the server has no service ${name}` });
    const call = this.nextCall++;
    const encoder = new TextEncoder();
    const encoding = encoder.encode("json");
    const body = encoder.encode(JSON.stringify({ token: this.token, ...request }));
    const bytes = new Uint8Array(13 + encoding.length + body.length);
    const view = new DataView(bytes.buffer);
    view.setUint8(0, SERVICE_REQUEST);
    view.setUint32(1, service, true);
    view.setUint32(5, call, true);
    view.setUint32(9, encoding.length, true);
    bytes.set(encoding, 13);
    bytes.set(body, 13 + encoding.length);
    this.socket.send(bytes);
    return new Promise((resolve) => this.calls.set(call, resolve));
  }
}

/** A JSON payload. @param {DataView} data */
export function json(data) {
  return JSON.parse(new TextDecoder().decode(new Uint8Array(data.buffer, data.byteOffset, data.byteLength)));
}
