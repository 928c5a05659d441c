// Field offsets of the hub's messages, read from the `ros2msg` schema text that each channel carries.
// The messages are C structs without padding, so the fields are contiguous in the order of the text.

const SCALARS = {
  bool: [1, "getUint8"], byte: [1, "getUint8"], char: [1, "getUint8"],
  int8: [1, "getInt8"], uint8: [1, "getUint8"], int16: [2, "getInt16"], uint16: [2, "getUint16"],
  int32: [4, "getInt32"], uint32: [4, "getUint32"], int64: [8, "getBigInt64"], uint64: [8, "getBigUint64"],
  float32: [4, "getFloat32"], float64: [8, "getFloat64"],
};

/** Bytes before the struct: the CDR header. */
const CDR_HEADER_BYTES = 4;

/**
 * @typedef {{offset: number, reader: string, bytes: number}} Field
 * @typedef {{fields: Map<string, Field>, bytes: number}} Layout
 */

/** Splits the schema text into messages: the first is the channel's own, the others follow `MSG: name`
 * lines. */
function blocks(text) {
  const found = new Map();
  text.split(/^=+\s*$/m).forEach((part, i) => {
    const lines = part.split("\n").map((line) => line.replace(/#.*$/, "").trim()).filter((line) => line !== "");
    const head = lines[0]?.match(/^MSG:\s*(\S+)$/);
    const name = head ? head[1].split("/").pop() : i === 0 ? "" : undefined;
    if (name !== undefined) found.set(name, head ? lines.slice(1) : lines);
  });
  return found;
}

/**
 * Returns the offsets of all scalars, such as `t_world_link[3].position_m[0]`, up to the first sequence of
 * variable length. Offsets count from the start of the payload, its CDR header included.
 * @param {string} text a `ros2msg` schema @returns {Layout}
 */
export function layoutOf(text) {
  const messages = blocks(text);
  const fields = new Map();
  const place = (name, prefix, start) => {
    let offset = start;
    for (const line of messages.get(name) ?? []) {
      const match = line.match(/^([\w/]+)(\[(\d*)\])?\s+(\w+)$/);
      if (!match || match[1] === "string") break;
      if (match[2] && match[3] === "") break;
      const count = match[2] ? Number(match[3]) : 1;
      for (let i = 0; i < count; i++) {
        const path = `${prefix}${match[4]}${match[2] ? `[${i}]` : ""}`;
        const scalar = SCALARS[match[1]];
        if (scalar) {
          fields.set(path, { offset, bytes: scalar[0], reader: scalar[1] });
          offset += scalar[0];
        } else {
          offset = place(match[1].split("/").pop(), `${path}.`, offset);
        }
      }
    }
    return offset;
  };
  const bytes = place("", "", CDR_HEADER_BYTES);
  return { fields, bytes };
}

/**
 * Returns a function that reads one field of a message as a number, or undefined if the layout lacks it.
 * @param {Layout} layout @param {string} path @returns {((view: DataView) => number) | undefined}
 */
export function reader(layout, path) {
  const field = layout.fields.get(path);
  if (!field) return undefined;
  const { offset, reader: name } = field;
  if (name.includes("Big")) return (view) => Number(view[name](offset, true));
  return (view) => view[name](offset, true);
}
