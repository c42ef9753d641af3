// Environment maps that are dropped on the page: Radiance .hdr, and OpenEXR scanlines of half or float.

const MOST_PIXELS = 8192 * 4096;

async function readMap(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  const isExr = bytes.length > 8 && new DataView(bytes.buffer).getUint32(0, true) === 20000630;
  const map = isExr ? await readExr(bytes) : readHdr(bytes);
  if (map.width !== 2 * map.height) {
    throw new Error(`${file.name}: ${map.width} x ${map.height} pixels; a lat-long map is twice as wide as high`);
  }
  for (let i = 0; i < map.pixels.length; i++) {
    if (!(map.pixels[i] > 0)) map.pixels[i] = 0;
    else if (map.pixels[i] > 65504) map.pixels[i] = 65504;
  }
  return new LatLong(file.name, map.width, map.height, map.pixels);
}

function checkSize(width, height) {
  if (!(width > 0 && height > 0 && width * height <= MOST_PIXELS)) {
    throw new Error("the map is damaged or too large; give one of 8192 x 4096 pixels at most");
  }
}

// Radiance RGBE: a text header, "-Y H +X W", then rows, run-length coded or flat.
function readHdr(bytes) {
  const newline = 10;
  let at = 0;
  const line = () => {
    let text = "";
    while (at < bytes.length && bytes[at] !== newline && text.length < 1000) text += String.fromCharCode(bytes[at++]);
    at++;
    return text;
  };
  if (!line().startsWith("#?")) throw new Error("neither an .hdr nor an .exr map; convert it to one of them");
  while (at < bytes.length && line() !== "");
  const size = /^-Y (\d+) \+X (\d+)\s*$/.exec(line());
  if (!size) throw new Error("an .hdr of rotated rows; save it again with -Y H +X W");
  const [height, width] = [Number(size[1]), Number(size[2])];
  checkSize(width, height);
  const pixels = new Float32Array(3 * width * height);
  const row = new Uint8Array(4 * width);
  for (let y = 0; y < height; y++) {
    at = hdrRow(bytes, at, row, width);
    for (let x = 0; x < width; x++) {
      const scale = row[3 * width + x] ? 2 ** (row[3 * width + x] - 136) : 0;
      for (let c = 0; c < 3; c++) pixels[3 * (y * width + x) + c] = row[c * width + x] * scale;
    }
  }
  return { width, height, pixels };
}

// Decode one row into planes R, G, B, E; return where the next one begins.
function hdrRow(bytes, start, row, width) {
  let at = start;
  const need = (count) => {
    if (at + count > bytes.length) throw new Error("the .hdr map is cut short; copy it again");
  };
  need(4);
  const coded = bytes[at] === 2 && bytes[at + 1] === 2 && (bytes[at + 2] << 8) + bytes[at + 3] === width;
  if (!coded) {
    need(4 * width);
    for (let x = 0; x < width; x++) for (let c = 0; c < 4; c++) row[c * width + x] = bytes[at++];
    return at;
  }
  at += 4;
  for (let c = 0; c < 4; c++) {
    for (let x = 0; x < width; ) {
      need(2);
      let count = bytes[at++];
      const run = count > 128;
      if (run) count -= 128;
      if (!count || x + count > width) throw new Error("the .hdr map is damaged; save it again");
      if (!run) need(count);
      for (let i = 0; i < count; i++) row[c * width + x++] = run ? bytes[at] : bytes[at + i];
      at += run ? 1 : count;
    }
  }
  return at;
}

const EXR_COMPRESSION = { 0: 1, 2: 1, 3: 16 }; // rows in a block: none, ZIPS, ZIP
const EXR_REFUSED = ["", "RLE", "", "", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"];
const EXR_BYTES = [4, 2, 4]; // of unsigned integers, halves, floats

async function readExr(bytes) {
  const view = new DataView(bytes.buffer);
  if (view.getUint32(4, true) & 0x1a00) throw new Error("an .exr of tiles or several parts; save plain scanlines");
  const { attributes, end } = exrHeader(bytes, view);
  const kind = bytes[attributes.compression.at];
  const rows = EXR_COMPRESSION[kind];
  if (!rows) throw new Error(`an .exr with ${EXR_REFUSED[kind] || "unknown"} compression; save it with ZIP or none`);
  const [left, top, right, bottom] = [0, 4, 8, 12].map((i) => view.getInt32(attributes.dataWindow.at + i, true));
  const [width, height] = [right - left + 1, bottom - top + 1];
  checkSize(width, height);
  const channels = exrChannels(bytes, view, attributes.channels);
  const rowBytes = channels.reduce((sum, one) => sum + width * EXR_BYTES[one.type], 0);
  const pixels = new Float32Array(3 * width * height);
  for (let block = 0; block < Math.ceil(height / rows); block++) {
    const at = Number(view.getBigUint64(end + 8 * block, true));
    const first = view.getInt32(at, true) - top;
    const count = Math.min(rows, height - first);
    if (first < 0 || count < 1) throw new Error("the .exr map is damaged; save it again");
    const packed = bytes.subarray(at + 8, at + 8 + view.getInt32(at + 4, true));
    const raw = kind && packed.length < count * rowBytes ? await exrUnzipped(packed, count * rowBytes) : packed;
    if (raw.length < count * rowBytes) throw new Error("the .exr map is cut short; copy it again");
    exrRows(raw, channels, width, first, count, rowBytes, pixels);
  }
  return { width, height, pixels };
}

function exrHeader(bytes, view) {
  let at = 8;
  const text = () => {
    let found = "";
    while (bytes[at]) found += String.fromCharCode(bytes[at++]);
    at++;
    return found;
  };
  const attributes = {};
  while (at < bytes.length && bytes[at]) {
    const name = text();
    text();
    const size = view.getInt32(at, true);
    attributes[name] = { at: at + 4, size };
    at += 4 + Math.max(0, size);
  }
  for (const name of ["channels", "compression", "dataWindow"]) {
    if (!attributes[name]) throw new Error("the .exr map is damaged; save it again");
  }
  return { attributes, end: at + 1 };
}

// Channels in the order of the file: their type, and which of R, G, B they are (Y is all of them).
function exrChannels(bytes, view, attribute) {
  const found = [];
  for (let at = attribute.at; bytes[at] && at < attribute.at + attribute.size; at += 17) {
    let name = "";
    while (bytes[at]) name += String.fromCharCode(bytes[at++]);
    const type = view.getInt32(at + 1, true);
    if (!(type in EXR_BYTES)) throw new Error("the .exr map is damaged; save it again");
    found.push({ type, to: name === "Y" ? [0, 1, 2] : ["R", "G", "B"].flatMap((c, i) => (c === name ? [i] : [])) });
  }
  if (!found.some((one) => one.to.length)) throw new Error("the .exr map has no channels R, G, B; save it as RGB");
  return found;
}

async function exrUnzipped(packed, size) {
  try {
    return await exrInflated(packed, size);
  } catch {
    throw new Error("the .exr map is damaged or cut short; copy it again");
  }
}

// ZIP of EXR: inflated, then differences of bytes, in two halves that are interleaved.
async function exrInflated(packed, size) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const coded = new Uint8Array(await new Response(stream).arrayBuffer());
  for (let i = 1; i < coded.length; i++) coded[i] = coded[i - 1] + coded[i] - 128;
  const raw = new Uint8Array(size);
  const half = (coded.length + 1) >> 1;
  for (let i = 0; i < Math.min(size, coded.length); i++) raw[i] = coded[i & 1 ? half + (i >> 1) : i >> 1];
  return raw;
}

function exrRows(raw, channels, width, first, count, rowBytes, pixels) {
  const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
  for (let y = 0; y < count; y++) {
    let at = y * rowBytes;
    for (const { type, to } of channels) {
      for (let x = 0; x < width; x++, at += EXR_BYTES[type]) {
        if (!to.length) continue;
        const value =
          type === 1 ? halfValue(view.getUint16(at, true)) : type === 2 ? view.getFloat32(at, true) : view.getUint32(at, true);
        for (const c of to) pixels[3 * ((first + y) * width + x) + c] = value;
      }
    }
  }
}
