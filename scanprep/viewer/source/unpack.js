// Scenes as `scanprep/pictures/scene.py` packs them: a header in JSON and the columns of numbers that it names.

const TYPES = { u1: Uint8Array, u2: Uint16Array, i2: Int16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array };

export async function inflate(bytes, format) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export function fromBase64(text) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

// The header of a packed scene, in which every column has become an array of numbers.
export async function unpackScene(packed) {
  const bytes = await inflate(packed, "deflate");
  const length = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  if (header.format !== 1) throw new Error(`a scene of format ${header.format}; this viewer knows format 1`);
  const start = 4 + length;
  const columns = header.columns.map((column) => readColumn(bytes, start + column.at, column));
  return { ...header, columns };
}

// Bytes lie plane by plane (all lowest bytes first), and rows may be differences to the row before: both compress well.
function readColumn(bytes, at, { type, rows, width, differences }) {
  const Type = TYPES[type];
  const size = Type.BYTES_PER_ELEMENT;
  const count = rows * width;
  const raw = new Uint8Array(count * size);
  for (let plane = 0; plane < size; plane++) {
    const from = at + plane * count;
    for (let i = 0, to = plane; i < count; i++, to += size) raw[to] = bytes[from + i];
  }
  const values = new Type(raw.buffer);
  if (differences) {
    // differences are stored as 0, -1, 1, -2, ... and wrap around
    for (let i = 0; i < count; i++) {
      const step = (values[i] >>> 1) ^ -(values[i] & 1);
      values[i] = (i < width ? 0 : values[i - width]) + step;
    }
  }
  return values;
}
