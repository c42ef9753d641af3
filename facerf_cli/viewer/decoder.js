// The decoder of the Reflectance Network (network/reflectance_default.py): the face's texture under one light.

const SHADOW_KERNEL = 70;
const ROOT_OFFSET = 0.02;
const DARKEST = 1e-8;
const GLOSS_POWER = 8;
const LIKENESS_POWER = 8; // light/quotient.py

class Decoder {
  constructor(data, arrays) {
    Object.assign(this, data.decoder);
    this.arrays = arrays;
    this.texturePx = Math.sqrt(arrays.faceTexture.length / 3);
    this.rig = arrays.decoderRig;
    this.shadowPx = Math.sqrt((3 * arrays.meanShadow.length) / this.rig.length);
    const texels = this.texturePx ** 2;
    this.root = arrays.faceTexture.map((value, i) =>
      Math.sqrt(Math.max(DARKEST, value * this.sourceScale[Math.floor(i / texels)])),
    );
    this.explainedPx = Math.sqrt(arrays.quotientExplained.length);
    this.explainedLength = Math.hypot(...arrays.quotientExplained);
    this.ratio = enlarged(arrays.quotientRatio, 3, this.explainedPx, this.texturePx);
  }

  // The texture [3, T, T] under a light of rgb 1; yields between levels, so that a page stays alive.
  *texture(toward) {
    const { maps, base, code } = this.lightInputs(toward);
    let x = null;
    let side = this.side / 2 ** (this.levels - 1);
    for (let level = 0; level < this.levels; level++, side *= 2) {
      x = this.level(level, x, maps, code, side);
      yield;
    }
    const head = convolved(x, this.layer("head"), this.side);
    for (let c = 0; c < 3; c++) for (let i = 0; i < base.length; i++) head[c * base.length + i] += base[i];
    const linear = enlarged(head, 6, this.side, this.texturePx);
    const half = linear.length / 2;
    const texture = new Float32Array(half);
    for (let i = 0; i < half; i++) {
      const root = Math.max(0, this.root[i] * linear[i] + linear[half + i]);
      texture[i] = root * (root + 2 * ROOT_OFFSET) * this.sourceExposure;
    }
    return this.corrected(texture);
  }

  level(level, below, maps, code, side) {
    let x = Float32Array.from(this.arrays[`fixed${level}`]);
    const light = convolved(averaged(maps, 4, this.side, this.side / side), this.layer(`light${level}`), side);
    const entered = level ? doubled(mixed(below, this.layer(`enter${level}`)), this.width(level), side / 2) : null;
    const modulation = dense(code, this.layer(`modulation${level}`));
    const area = side * side;
    const width = x.length / area;
    for (let c = 0; c < width; c++) {
      const [scale, shift] = [1 + modulation[c], modulation[width + c]];
      for (let i = c * area; i < (c + 1) * area; i++) {
        x[i] = silu((x[i] + light[i] + (entered ? entered[i] : 0)) * scale + shift);
      }
    }
    for (const name of ["inner", "outer"]) {
      const change = convolved(x, this.layer(name + level), side);
      for (let i = 0; i < x.length; i++) x[i] += silu(change[i]);
    }
    return x;
  }

  layer(name) {
    return { weights: this.arrays[name], biases: this.arrays[name + "Bias"] };
  }

  width(level) {
    return this.arrays[`inner${level}Bias`].length;
  }

  // Maps of cosine, gloss, shadow and base gain [4, side, side], the base alone, and the light's code.
  lightInputs(toward) {
    const turn = this.headToCamera;
    const inHead = [0, 1, 2].map((k) => toward[0] * turn[k] + toward[1] * turn[3 + k] + toward[2] * turn[6 + k]);
    const half = unit([toward[0], toward[1], toward[2] + 1]);
    const shadow = this.meanShadow(inHead);
    const area = this.side * this.side;
    const maps = new Float32Array(4 * area);
    const normals = this.arrays.decoderNormals;
    for (let i = 0; i < area; i++) {
      const along = (vector) => normals[i] * vector[0] + normals[area + i] * vector[1] + normals[2 * area + i] * vector[2];
      const cosine = along(toward);
      maps[i] = cosine;
      maps[area + i] = Math.max(0, along(half)) ** GLOSS_POWER;
      maps[2 * area + i] = shadow[i];
      maps[3 * area + i] = Math.sqrt(Math.max(0, cosine) * shadow[i] + 1e-4);
    }
    const [x, y, z] = inHead;
    const features = [...toward, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z];
    const first = dense(features, this.layer("code0")).map(silu);
    return { maps, base: maps.subarray(3 * area), code: dense(first, this.layer("code1")).map(silu) };
  }

  // The visibility of the mean face, between the lights for which it is known.
  meanShadow(inHead) {
    const count = this.rig.length / 3;
    const cosines = Array.from({ length: count }, (_, i) => [0, 1, 2].reduce((sum, k) => sum + inHead[k] * this.rig[k * count + i], 0));
    const most = Math.max(...cosines);
    const shares = cosines.map((value) => Math.exp(SHADOW_KERNEL * (value - most)));
    const total = shares.reduce((a, b) => a + b);
    const area = this.shadowPx ** 2;
    const sum = new Float32Array(area);
    shares.forEach((share, light) => {
      if (share < 1e-7 * total) return;
      for (let i = 0; i < area; i++) sum[i] += (share / total) * this.arrays.meanShadow[light * area + i];
    });
    return enlarged(sum, 1, this.shadowPx, this.side);
  }

  // A texture corrected by the photo's quotient, as far as the light shades the face alike (light/quotient.py).
  corrected(texture) {
    const explained = this.arrays.quotientExplained;
    const small = averaged(texture, 3, this.texturePx, this.texturePx / this.explainedPx);
    let [along, length] = [0, 0];
    for (let i = 0; i < explained.length; i++) {
      const grey = (small[i] + small[explained.length + i] + small[2 * explained.length + i]) / 3;
      along += grey * explained[i];
      if (explained[i] > 0) length += grey * grey;
    }
    const likeness = Math.min(1, Math.max(0, along / Math.max(Math.sqrt(length) * this.explainedLength, 1e-12)));
    const power = likeness ** LIKENESS_POWER;
    for (let i = 0; i < texture.length; i++) texture[i] *= Math.exp(power * this.ratio[i]);
    return texture;
  }
}

function silu(x) {
  return x / (1 + Math.exp(-x));
}

function dense(values, { weights, biases }) {
  return Float32Array.from(biases, (bias, row) => {
    let sum = bias;
    for (let i = 0; i < values.length; i++) sum += weights[row * values.length + i] * values[i];
    return sum;
  });
}

// Planes mixed by weights [out, in], a convolution of one pixel.
function mixed(planes, { weights, biases }) {
  const inputs = weights.length / biases.length;
  const area = planes.length / inputs;
  const result = new Float32Array(biases.length * area);
  for (let o = 0; o < biases.length; o++) {
    const out = result.subarray(o * area, (o + 1) * area).fill(biases[o]);
    for (let k = 0; k < inputs; k++) {
      const weight = weights[o * inputs + k];
      const from = k * area;
      for (let i = 0; i < area; i++) out[i] += weight * planes[from + i];
    }
  }
  return result;
}

// A convolution of 3 x 3 pixels by weights [out, in, 3, 3]; beyond the border there is 0.
function convolved(planes, { weights, biases }, side) {
  const inputs = weights.length / (9 * biases.length);
  const wide = side + 2;
  const padded = new Float32Array(inputs * wide * wide);
  for (let k = 0; k < inputs; k++) {
    for (let y = 0; y < side; y++) {
      const from = (k * side + y) * side;
      padded.set(planes.subarray(from, from + side), (k * wide + y + 1) * wide + 1);
    }
  }
  const result = new Float32Array(biases.length * side * side);
  for (let o = 0; o < biases.length; o++) {
    const out = result.subarray(o * side * side, (o + 1) * side * side).fill(biases[o]);
    for (let k = 0; k < inputs; k++) addPlane(out, padded, k * wide * wide, weights, 9 * (o * inputs + k), side);
  }
  return result;
}

function addPlane(out, padded, start, weights, at, side) {
  const wide = side + 2;
  const [w0, w1, w2] = [weights[at], weights[at + 1], weights[at + 2]];
  const [w3, w4, w5] = [weights[at + 3], weights[at + 4], weights[at + 5]];
  const [w6, w7, w8] = [weights[at + 6], weights[at + 7], weights[at + 8]];
  for (let y = 0; y < side; y++) {
    const to = y * side;
    let above = start + y * wide;
    let here = above + wide;
    let below = here + wide;
    for (let x = 0; x < side; x++, above++, here++, below++) {
      out[to + x] +=
        w0 * padded[above] + w1 * padded[above + 1] + w2 * padded[above + 2] +
        w3 * padded[here] + w4 * padded[here + 1] + w5 * padded[here + 2] +
        w6 * padded[below] + w7 * padded[below + 1] + w8 * padded[below + 2];
    }
  }
}
