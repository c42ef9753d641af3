// Maps that are dropped on the page: Radiance .hdr, and OpenEXR scanlines of half or float.

const MOST_PIXELS = 8192 * 4096;
const EXR_MAGIC = 20000630;
const EXR_ROWS = { 0: 1, 2: 1, 3: 16 }; // in a block, by compression: none, ZIPS, ZIP
const EXR_BYTES = [4, 2, 4]; // of unsigned integers, halves, floats
const EXR_DAMAGED = "the .exr map is damaged or cut short; save or copy it again";

async function readMap(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  const isExr = bytes.length > 8 && new DataView(bytes.buffer).getUint32(0, true) === EXR_MAGIC;
  const { size, pixels } = isExr ? await readExr(bytes) : readHdr(bytes);
  if (size[0] !== 2 * size[1]) throw new Error(`${size.join(" x ")} pixels; a lat-long map is twice as wide as high`);
  return new LatLong({ name: file.name, size, pixels: pixels.map((value) => (value > 0 ? Math.min(value, 65504) : 0)) });
}

function newPixels(width, height) {
  const fits = width > 0 && height > 0 && width * height <= MOST_PIXELS;
  if (!fits) throw new Error("the map is damaged or too large; give one of 8192 x 4096 pixels at most");
  return new Float32Array(3 * width * height);
}

// Radiance RGBE: a text header, "-Y H +X W", then rows of planes R, G, B, E, run-length coded, or of pixels.
function readHdr(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 16));
  if (!text.startsWith("#?")) throw new Error("neither an .hdr nor an .exr map; convert it to one of them");
  const header = /\n\n-Y (\d+) \+X (\d+)\s*?\n/.exec(text);
  if (!header) throw new Error("an .hdr of rotated rows; save it again with -Y H +X W");
  const [height, width] = [Number(header[1]), Number(header[2])];
  const [pixels, row] = [newPixels(width, height), new Uint8Array(4 * width)];
  let at = header.index + header[0].length;
  const next = () => {
    if (at >= bytes.length) throw new Error("the .hdr map is cut short; copy it again");
    return bytes[at++];
  };
  for (let y = 0; y < height; y++) {
    const isCoded = bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] * 256 + bytes[at + 3] === width;
    at += isCoded ? 4 : 0;
    for (let i = 0; i < row.length; ) {
      if (!isCoded) {
        row[(i % 4) * width + (i++ >> 2)] = next();
        continue;
      }
      const code = next();
      const run = code > 128 ? next() : null;
      for (const end = i + (run === null ? code : code - 128); i < end; i++) row[i] = run ?? next();
    }
    for (let x = 0; x < width; x++) {
      const scale = row[3 * width + x] ? 2 ** (row[3 * width + x] - 136) : 0;
      for (let c = 0; c < 3; c++) pixels[3 * (y * width + x) + c] = row[c * width + x] * scale;
    }
  }
  return { size: [width, height], pixels };
}

async function readExr(bytes) {
  const view = new DataView(bytes.buffer);
  if (view.getUint32(4, true) & 0x1a00) throw new Error("an .exr of tiles or several parts; save plain scanlines");
  const { compression, top, width, height, channels, end } = exrHeader(bytes, view);
  const rows = EXR_ROWS[compression];
  if (!rows) throw new Error("an .exr with a compression that the page cannot read; save it with ZIP or none");
  if (!channels.some(({ to }) => to.length)) throw new Error("the .exr map has no channels R, G, B; save it as RGB");
  const pixels = newPixels(width, height);
  const rowBytes = channels.reduce((sum, channel) => sum + width * channel.bytes, 0);
  for (let block = 0; block * rows < height; block++) {
    const at = Number(view.getBigUint64(end + 8 * block, true));
    const first = view.getInt32(at, true) - top;
    const size = Math.min(rows, height - first) * rowBytes;
    let raw = bytes.subarray(at + 8, at + 8 + view.getInt32(at + 4, true));
    if (compression && raw.length < size) raw = await exrUnzipped(raw);
    if (first < 0 || !(size > 0) || raw.length < size) throw new Error(EXR_DAMAGED);
    exrBlock(new DataView(raw.buffer, raw.byteOffset, size), channels, width, pixels.subarray(3 * first * width));
  }
  return { size: [width, height], pixels };
}

// What the header says, and where it ends. A channel has the bytes of a value, and is R, G, B, or all of them (Y).
function exrHeader(bytes, view) {
  let at = 8;
  const word = () => {
    const start = at;
    at = bytes.indexOf(0, start) + 1;
    if (!at) throw new Error(EXR_DAMAGED);
    return String.fromCharCode(...bytes.subarray(start, at - 1));
  };
  const values = {}; // where those of attributes begin
  for (let name; (name = word()); at += Math.max(0, view.getInt32(at - 4, true))) {
    word(); // its type
    values[name] = at += 4;
  }
  const end = at;
  const [left, top, right, bottom] = [0, 4, 8, 12].map((i) => view.getInt32(values.dataWindow + i, true));
  const channels = [];
  at = values.channels ?? end - 1;
  for (let name; (name = word()); at += 16) {
    const type = view.getInt32(at, true);
    const colours = [0, 1, 2].filter((c) => name === "Y" || name === "RGB"[c]);
    channels.push({ bytes: EXR_BYTES[type], to: type ? colours : [] });
  }
  return { compression: bytes[values.compression], top, width: right - left + 1, height: bottom - top + 1, channels, end };
}

// ZIP of EXR: inflated, then differences of bytes, in two halves that are interleaved.
async function exrUnzipped(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const inflated = new Response(stream).arrayBuffer();
  const coded = new Uint8Array(await inflated.catch(() => Promise.reject(new Error(EXR_DAMAGED))));
  for (let i = 1; i < coded.length; i++) coded[i] = coded[i - 1] + coded[i] - 128;
  const half = (coded.length + 1) >> 1;
  return coded.map((_, i) => coded[i & 1 ? half + (i >> 1) : i >> 1]);
}

function exrBlock(view, channels, width, pixels) {
  for (let y = 0, at = 0; at < view.byteLength; y++) {
    for (const { bytes, to } of channels) {
      for (let x = 0; x < width; x++, at += bytes) {
        const value = bytes === 2 ? halfValue(view.getUint16(at, true)) : view.getFloat32(at, true);
        for (const c of to) pixels[3 * (y * width + x) + c] = value;
      }
    }
  }
}

// A half float's value, from its 16 bits.
function halfValue(bits) {
  const [sign, exponent, fraction] = [bits & 0x8000 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}
