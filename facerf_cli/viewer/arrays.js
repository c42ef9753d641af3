// The arrays of a page: inflated, and their steps turned back into numbers (arrays.py).

const ARRAY_BYTES = { half: 2, short: 2, index: 2, byte: 1 };

async function unpacked(document) {
  const stream = new Blob([bytesOf(document.bytes)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const found = {};
  for (const [name, entry] of Object.entries(document.arrays)) found[name] = arrayOf(bytes, entry);
  return found;
}

function arrayOf(bytes, entry) {
  const count = entry.shape.reduce((product, side) => product * side, 1);
  const wide = ARRAY_BYTES[entry.kind] === 2;
  const word = (i) => bytes[entry.at + i] + (wide ? 256 * bytes[entry.at + count + i] : 0);
  if (entry.kind === "index") {
    const whole = new Uint16Array(count);
    for (let i = 0, last = 0; i < count; i++) whole[i] = last = last + word(i);
    return whole;
  }
  const values = new Float32Array(count);
  if (entry.kind === "half") {
    for (let i = 0; i < count; i++) values[i] = halfValue(word(i));
    return values;
  }
  const plane = count / entry.shape[0];
  for (let c = 0, i = 0; c < entry.shape[0]; c++) {
    const [low, step] = [entry.low[c], entry.step[c]];
    for (const end = i + plane; i < end; i++) values[i] = low + step * word(i);
  }
  return values;
}
