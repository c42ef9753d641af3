// Bytes in base64 to arrays and images; nothing is fetched.

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

function floatsOf(base64) {
  return new Float32Array(bytesOf(base64).buffer);
}

function wordsOf(base64) {
  return new Uint16Array(bytesOf(base64).buffer);
}

async function imageOf(base64, type) {
  const image = new Image();
  image.src = `data:${type};base64,${base64}`;
  await image.decode();
  return image;
}

// A half float's value, from its 16 bits.
function halfValue(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

function halvesOf(words) {
  return Float32Array.from(words, halfValue);
}

// The bytes [R, G, B, A, ...] of an image.
function pixelsOf(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.width;
  canvas.height = image.height;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, image.width, image.height).data;
}
