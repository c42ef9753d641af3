// Lights and maps as weights of the lights of an OLAT stack, and the readers of maps.
// Conventions are facerf's (docs/design.md): azimuth > 0 lights the image's right side, elevation > 0 from above.

const DEGREE = Math.PI / 180;
const MAP_ROWS = 256; // of the grid on which the cells of the lights are found
const MOST_PIXELS = 8192 * 4096; // of a map

const byId = (id) => document.getElementById(id);
const limited = (value, low, high) => Math.min(high, Math.max(low, value));
const turned = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const luminance = (rgb) => 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
const decoded = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
const encoded = (x) => (x <= 0.0031308 ? 12.92 * Math.max(0, x) : 1.055 * Math.min(1, x) ** (1 / 2.4) - 0.055);
const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
const floatsOf = (base64) => new Float32Array(bytesOf(base64).buffer);
const triples = (flat) => Array.from({ length: flat.length / 3 }, (_, i) => Array.from(flat.subarray(3 * i, 3 * i + 3)));

function directionOf(azimuth, elevation) {
  const ring = Math.cos(elevation * DEGREE);
  return [ring * Math.sin(azimuth * DEGREE), Math.sin(elevation * DEGREE), ring * Math.cos(azimuth * DEGREE)];
}

// A half float's value, from its 16 bits.
function halfValue(bits) {
  const [sign, exponent, fraction] = [bits & 0x8000 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}

async function imageOf(base64, type) {
  const image = new Image();
  image.src = `data:image/${type};base64,${base64}`;
  await image.decode();
  return image;
}

// The bytes [R, G, B, A, ...] of an image at a size.
function pixelsOf(image, width, height) {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

class Rig {
  constructor(data) {
    this.lights = triples(floatsOf(data.directions));
    this.triangles = triples(new Uint16Array(bytesOf(data.triangles).buffer));
    this.inverses = this.triangles.map((triangle) => {
      const [a, b, c] = triangle.map((i) => this.lights[i]);
      const rows = [cross(b, c), cross(c, a), cross(a, b)];
      const volume = dot(a, rows[0]);
      return rows.map((row) => row.map((value) => value / volume));
    });
  }

  nearest(toward) {
    const cosines = this.lights.map((light) => dot(light, toward));
    return cosines.indexOf(Math.max(...cosines));
  }

  // Lights around a direction and their shares; the nearest one where no triangle is.
  around(toward) {
    for (const [t, rows] of this.inverses.entries()) {
      const shares = rows.map((row) => dot(row, toward));
      const total = shares[0] + shares[1] + shares[2];
      const inside = Math.min(...shares) >= -1e-4 && total > 0;
      if (inside) return this.triangles[t].map((light, i) => [light, shares[i] / total]);
    }
    return [[this.nearest(toward), 1]];
  }

  // The light that is nearest to each texel of a lat-long grid, computed once.
  get cells() {
    const degrees = 180 / MAP_ROWS; // of a row, and of a column
    this.nearestCells ??= Uint16Array.from({ length: 2 * MAP_ROWS * MAP_ROWS }, (_, i) => {
      const [row, column] = [Math.floor(i / (2 * MAP_ROWS)), i % (2 * MAP_ROWS)];
      return this.nearest(directionOf(180 - degrees * (column + 0.5), 90 - degrees * (row + 0.5)));
    });
    return this.nearestCells;
  }

  // Weights [lights * 3] under a turned map: its integral over each light's cell, over pi.
  mapWeights(map, degrees) {
    const weights = new Float64Array(3 * this.lights.length);
    const width = 2 * MAP_ROWS;
    for (let row = 0; row < MAP_ROWS; row++) {
      const band = Math.sin((0.5 - row / MAP_ROWS) * Math.PI) - Math.sin((0.5 - (row + 1) / MAP_ROWS) * Math.PI);
      for (let column = 0; column < width; column++) {
        const radiance = map.at((column + 0.5) / width + degrees / 360, (row + 0.5) / MAP_ROWS);
        const to = 3 * this.cells[row * width + column];
        for (let c = 0; c < 3; c++) weights[to + c] += (radiance[c] * band * 2) / width;
      }
    }
    return weights;
  }
}

// A lat-long map [height, width, 3]; a large one is averaged down to the rows of the grid.
class LatLong {
  constructor(name, width, height, pixels, command = "", path = name) {
    const rows = Math.min(height, MAP_ROWS);
    Object.assign(this, { name, command, path, width: 2 * rows, height: rows });
    this.pixels = new Float32Array(6 * rows * rows);
    const counts = new Uint32Array(2 * rows * rows);
    for (let i = 0; i < width * height; i++) {
      const row = Math.floor((Math.floor(i / width) * rows) / height);
      const to = row * 2 * rows + Math.floor(((i % width) * 2 * rows) / width);
      counts[to]++;
      for (let c = 0; c < 3; c++) this.pixels[3 * to + c] += pixels[3 * i + c];
    }
    for (let i = 0; i < this.pixels.length; i++) this.pixels[i] /= counts[Math.floor(i / 3)];
  }

  // The radiance at (u, v); u is in turns.
  at(u, v) {
    const column = Math.min(this.width - 1, Math.floor((u - Math.floor(u)) * this.width));
    const from = 3 * (Math.floor(v * this.height) * this.width + column);
    return [this.pixels[from], this.pixels[from + 1], this.pixels[from + 2]];
  }
}

// ---- Maps that are dropped on the page: Radiance .hdr, and OpenEXR scanlines of half or float ----

async function readMap(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  const isExr = bytes.length > 8 && new DataView(bytes.buffer).getUint32(0, true) === 20000630;
  const { width, height, pixels } = isExr ? await readExr(bytes) : readHdr(bytes);
  if (width !== 2 * height) throw new Error(`${width} x ${height} pixels; a lat-long map is twice as wide as high`);
  const finite = pixels.map((value) => (value > 0 ? Math.min(value, 65504) : 0));
  return new LatLong(file.name, width, height, finite);
}

function newPixels(width, height) {
  const fits = width > 0 && height > 0 && width * height <= MOST_PIXELS;
  if (!fits) throw new Error("the map is damaged or too large; give one of 8192 x 4096 pixels at most");
  return new Float32Array(3 * width * height);
}

// Radiance RGBE: a text header, "-Y H +X W", then rows, run-length coded or flat.
function readHdr(bytes) {
  let at = 0;
  const line = () => {
    let text = "";
    while (at < bytes.length && bytes[at] !== 10 && text.length < 1000) text += String.fromCharCode(bytes[at++]);
    at++;
    return text;
  };
  if (!line().startsWith("#?")) throw new Error("neither an .hdr nor an .exr map; convert it to one of them");
  while (at < bytes.length && line() !== "");
  const size = /^-Y (\d+) \+X (\d+)\s*$/.exec(line());
  if (!size) throw new Error("an .hdr of rotated rows; save it again with -Y H +X W");
  const [height, width] = [Number(size[1]), Number(size[2])];
  const pixels = newPixels(width, height);
  const row = new Uint8Array(4 * width); // planes R, G, B, E
  for (let y = 0; y < height; y++) {
    at = hdrRow(bytes, at, row, width);
    for (let x = 0; x < width; x++) {
      const scale = row[3 * width + x] ? 2 ** (row[3 * width + x] - 136) : 0;
      for (let c = 0; c < 3; c++) pixels[3 * (y * width + x) + c] = row[c * width + x] * scale;
    }
  }
  return { width, height, pixels };
}

// Decode one row; return where the next one begins.
function hdrRow(bytes, start, row, width) {
  let at = start;
  const next = () => {
    if (at >= bytes.length) throw new Error("the .hdr map is cut short; copy it again");
    return bytes[at++];
  };
  const coded = bytes[at] === 2 && bytes[at + 1] === 2 && (bytes[at + 2] << 8) + bytes[at + 3] === width;
  if (!coded) {
    for (let i = 0; i < 4 * width; i++) row[(i % 4) * width + (i >> 2)] = next();
    return at;
  }
  at += 4;
  for (let c = 0; c < 4; c++) {
    for (let x = 0; x < width; ) {
      const code = next();
      const [count, run] = [code > 128 ? code - 128 : code, code > 128 ? next() : null];
      if (!count || x + count > width) throw new Error("the .hdr map is damaged; save it again");
      for (const end = x + count; x < end; x++) row[c * width + x] = run ?? next();
    }
  }
  return at;
}

const EXR_ROWS = { 0: 1, 2: 1, 3: 16 }; // in a block, by compression: none, ZIPS, ZIP
const EXR_BYTES = [4, 2, 4]; // of unsigned integers, halves, floats
const EXR_DAMAGED = "the .exr map is damaged or cut short; save or copy it again";

async function readExr(bytes) {
  const view = new DataView(bytes.buffer);
  if (view.getUint32(4, true) & 0x1a00) throw new Error("an .exr of tiles or several parts; save plain scanlines");
  const { attributes, end } = exrHeader(bytes, view);
  const kind = bytes[attributes.compression];
  const rows = EXR_ROWS[kind];
  if (!rows) throw new Error("an .exr with a compression that the page cannot read; save it with ZIP or none");
  const [left, top, right, bottom] = [0, 4, 8, 12].map((i) => view.getInt32(attributes.dataWindow + i, true));
  const [width, height] = [right - left + 1, bottom - top + 1];
  const pixels = newPixels(width, height);
  const channels = exrChannels(bytes, view, attributes.channels);
  const rowBytes = channels.reduce((sum, { bytes }) => sum + width * bytes, 0);
  for (let block = 0; block < Math.ceil(height / rows); block++) {
    const at = Number(view.getBigUint64(end + 8 * block, true));
    const first = view.getInt32(at, true) - top;
    const size = Math.min(rows, height - first) * rowBytes;
    let raw = bytes.subarray(at + 8, at + 8 + view.getInt32(at + 4, true));
    if (kind && raw.length < size) raw = await exrUnzipped(raw);
    if (first < 0 || !(size > 0) || raw.length < size) throw new Error(EXR_DAMAGED);
    exrBlock(new DataView(raw.buffer, raw.byteOffset, size), channels, width, pixels.subarray(3 * first * width));
  }
  return { width, height, pixels };
}

// Where the values of the header's attributes begin, and where the header ends.
function exrHeader(bytes, view) {
  let at = 8;
  const text = () => {
    const start = at;
    while (bytes[at]) at++;
    return String.fromCharCode(...bytes.subarray(start, at++));
  };
  const attributes = {};
  while (bytes[at]) {
    const name = text();
    text(); // its type
    attributes[name] = at + 4;
    at += 4 + Math.max(0, view.getInt32(at, true));
  }
  if (["channels", "compression", "dataWindow"].some((name) => !(name in attributes))) throw new Error(EXR_DAMAGED);
  return { attributes, end: at + 1 };
}

// Channels in the order of the file: bytes of a value, and which of R, G, B they are: Y is all, integers are none.
function exrChannels(bytes, view, start) {
  const channels = [];
  for (let at = start; bytes[at]; at += 17) {
    let name = "";
    while (bytes[at]) name += String.fromCharCode(bytes[at++]);
    const type = view.getInt32(at + 1, true);
    if (!(type in EXR_BYTES)) throw new Error(EXR_DAMAGED);
    const colours = [0, 1, 2].filter((c) => name === "Y" || "RGB"[c] === name);
    channels.push({ bytes: EXR_BYTES[type], to: type ? colours : [] });
  }
  if (!channels.some(({ to }) => to.length)) throw new Error("the .exr map has no channels R, G, B; save it as RGB");
  return channels;
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
