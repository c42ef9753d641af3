// The portrait field: shading and highlights of the whole person under a light (network/portrait.py), corrected
// so that the photo's own light gives the photo back (portrait/correction.py).

const LIT_TERMS = 16; // spherical harmonics up to order 3
const SHADOW_TERMS = 25; // and up to 4
const SMALL_PX = 48; // side at which likeness is measured
const MOST_LIKELY = 1.5;
const LOBES = [8, 45];
const STRANDS = 30;
const CHANGE_BLOCK = 4;
const CHANGE_MARGIN = 56;
const CHANGE_SIGMA = 3.489; // of 14 pixels: blocks blur, too
const NETWORK_PX = 2; // pixels of the fine maps along one of the coarse

class Portrait {
  constructor(data, arrays) {
    Object.assign(this, data.person);
    this.arrays = arrays;
    this.pixels = this.side * this.side;
    this.shadows = new Shadows(arrays, this.side / NETWORK_PX);
    this.people = arrays.share.reduce((a, b) => a + b);
    this.explained = this.small(arrays.explained);
    this.explainedLength = Math.hypot(...this.explained);
    this.kept = new Map();
  }

  // Shading and highlights [side, side] of a light of rgb 1, and what their correction takes.
  single(toward) {
    const key = toward.join();
    if (!this.kept.has(key)) {
      if (this.kept.size > 2 * MOST_LIGHTS) this.kept.delete(this.kept.keys().next().value);
      this.kept.set(key, this.corrected(...this.shaded(toward)));
    }
    return this.kept.get(key);
  }

  shaded(toward) {
    const { arrays, side, pixels } = this;
    const visible = doubled(this.shadows.visibility(toward), 1, side / NETWORK_PX);
    const basis = harmonics(toward);
    const over = (planes, terms) => this.over(basis, planes, terms);
    const [lit, around, shadow] = [over(arrays.lit, LIT_TERMS), over(arrays.around, LIT_TERMS), over(arrays.shadow, SHADOW_TERMS)];
    const half = unit([toward[0], toward[1], toward[2] + 1]);
    const [shade, glow] = [new Float32Array(pixels), new Float32Array(pixels)];
    const { normals, strands, gloss, trust } = arrays;
    for (let i = 0; i < pixels; i++) {
      const v = 1 / (1 + Math.exp(-(trust[i] * (2 * visible[i] - 1) + shadow[i])));
      const [nx, ny, nz] = [normals[i], normals[pixels + i], normals[2 * pixels + i]];
      const cosine = nx * toward[0] + ny * toward[1] + nz * toward[2];
      shade[i] = v * Math.max(cosine, 0) + Math.max(0, v * lit[i] + around[i]);
      const along = Math.log(Math.min(1, Math.max(1e-3, nx * half[0] + ny * half[1] + nz * half[2])));
      const across = strands[i] * half[0] + strands[pixels + i] * half[1] + strands[2 * pixels + i] * half[2];
      let shine = Math.exp(-0.5 * STRANDS * across * across) * gloss[2 * pixels + i];
      for (let j = 0; j < 2; j++) shine += Math.exp(LOBES[j] * along) * (LOBES[j] / 8) * gloss[j * pixels + i];
      glow[i] = v * shine;
    }
    return [shade, glow];
  }

  // A sum of coarse planes at the side of the fine ones.
  over(basis, planes, terms) {
    const small = this.side / NETWORK_PX;
    const sum = new Float32Array(small * small);
    for (let k = 0; k < terms; k++) {
      const [weight, from] = [basis[k], k * sum.length];
      for (let i = 0; i < sum.length; i++) sum[i] += weight * planes[from + i];
    }
    return doubled(sum, 1, small);
  }

  // A grey plane of the person, small.
  small(grey) {
    return averaged(grey.map((value, i) => value * this.arrays.share[i]), 1, this.side, this.side / SMALL_PX);
  }

  corrected(shade, glow) {
    const { albedo, share, explained, likeness } = this.arrays;
    const { pixels, floor } = this;
    const grey = new Float32Array(pixels);
    let total = 0;
    for (let i = 0; i < pixels; i++) {
      grey[i] = ((albedo[i] + albedo[pixels + i] + albedo[2 * pixels + i]) / 3) * shade[i] + glow[i];
      total += grey[i] * share[i];
    }
    const small = this.small(grey);
    let along = 0;
    for (let i = 0; i < small.length; i++) along += small[i] * this.explained[i];
    const cosine = along / Math.max(Math.hypot(...small) * this.explainedLength, 1e-12);
    const alike = Math.min(1, Math.max(0, cosine)) ** this.likenessPower;
    const brightness = total / Math.max(this.people, 1) / Math.max(this.mean, 1e-9);
    const power = new Float32Array(pixels);
    for (let i = 0; i < pixels; i++) {
      const brighter = (grey[i] + floor * brightness) / Math.max(brightness * (explained[i] + floor), 1e-9);
      power[i] = Math.min(alike / Math.max(brighter, 1) / likeness[i], MOST_LIKELY);
    }
    return { shade, glow, power, brightness };
  }

  // Shading and highlights [6, side, side] of lights {single, rgb}, as the photo corrects them.
  sum(lights) {
    const { excess } = this.arrays;
    const { pixels } = this;
    const result = new Float32Array(6 * pixels);
    for (const { single, rgb } of lights) {
      if (!(rgb[0] || rgb[1] || rgb[2])) continue;
      const { shade, glow, power } = single;
      const added = this.floor * single.brightness;
      for (let i = 0; i < pixels; i++) {
        for (let c = 0; c < 3; c++) {
          const change = power[i] * excess[c * pixels + i];
          const factor = change > -1 ? 1 + change : 0;
          result[c * pixels + i] += rgb[c] * shade[i] * factor;
          result[(3 + c) * pixels + i] += rgb[c] * (glow[i] * factor + change * added);
        }
      }
    }
    return result;
  }

  // The person [3, side, side] as coarse as the maps.
  relit(lit) {
    const { pixels, exposure } = this;
    const { albedo } = this.arrays;
    return Float32Array.from({ length: 3 * pixels }, (_, i) => (albedo[i] * lit[i] + lit[3 * pixels + i]) * exposure);
  }

  // The planes that the photo's pixels take: shading and shine [6, side, side], and the change beyond the square.
  wide(lit) {
    const { own, atBorder, beyond } = this.arrays;
    const { pixels, side } = this;
    const filled = inpainted(lit, 6, side, own);
    filled.set(gaussian(filled.subarray(3 * pixels), 3, side, 0.8), 3 * pixels);
    const change = beyondSquare(inpainted(this.relit(lit), 3, side, atBorder), side);
    for (let i = 0; i < change.length; i++) change[i] /= beyond[i];
    return { lit: filled, change };
  }
}

// The blur by which the change of light goes on beyond the square: planes [3, side, side] in blocks of four pixels,
// and a block more on each side (person_arrays.py).
function beyondSquare(planes, side) {
  const wide = side + 2 * CHANGE_MARGIN;
  const padded = new Float32Array(3 * wide * wide);
  const inside = (i) => Math.min(side - 1, Math.max(0, i - CHANGE_MARGIN));
  for (let c = 0, to = 0; c < 3; c++) {
    for (let y = 0; y < wide; y++) {
      const row = (c * side + inside(y)) * side;
      for (let x = 0; x < wide; x++) padded[to++] = planes[row + inside(x)];
    }
  }
  const blocks = wide / CHANGE_BLOCK;
  const blurred = gaussian(averaged(padded, 3, wide, CHANGE_BLOCK), 3, blocks, CHANGE_SIGMA);
  const kept = side / CHANGE_BLOCK + 2;
  const first = CHANGE_MARGIN / CHANGE_BLOCK - 1;
  const result = new Float32Array(3 * kept * kept);
  for (let c = 0, to = 0; c < 3; c++) {
    for (let y = 0; y < kept; y++) {
      for (let x = 0; x < kept; x++) result[to++] = blurred[(c * blocks + first + y) * blocks + first + x];
    }
  }
  return result;
}

// The place in those blocks of a place 0..1 in the square; beyond it the border goes on.
function blockAt(place, side) {
  return Math.min(side - 0.5, Math.max(0.5, place * side)) / CHANGE_BLOCK + 1;
}

function unit(vector) {
  const length = Math.max(Math.hypot(...vector), 1e-12);
  return vector.map((value) => value / length);
}

// Real spherical harmonics up to order 4 (light/sh.py).
function harmonics([x, y, z]) {
  const order = 4;
  const basis = new Float64Array((order + 1) ** 2);
  let [cosine, sine] = [1, 0];
  let start = Math.sqrt(1 / (4 * Math.PI));
  for (let m = 0; m <= order; m++) {
    if (m) start *= Math.sqrt((2 * m + 1) / (2 * m));
    const legendre = [start];
    if (order > m) legendre.push(Math.sqrt(2 * m + 3) * z * start);
    for (let l = m + 2; l <= order; l++) {
      const a = Math.sqrt((4 * l * l - 1) / (l * l - m * m));
      const b = Math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1));
      legendre.push(a * (z * legendre.at(-1) - b * legendre.at(-2)));
    }
    legendre.forEach((value, i) => {
      const l = m + i;
      const scale = m ? Math.SQRT2 : 1;
      basis[l * l + l - m] = scale * value * sine;
      basis[l * l + l + m] = scale * value * cosine;
    });
    [cosine, sine] = [x * cosine - y * sine, x * sine + y * cosine];
  }
  return basis;
}
