// Planes: images of one channel after another, [C, side, side] in one array.

// The side doubled, bilinearly, with pixel centres at half a pixel.
function doubled(planes, count, side) {
  const wide = 2 * side;
  const rows = new Float32Array(wide * side);
  const result = new Float32Array(count * wide * wide);
  for (let c = 0; c < count; c++) {
    const from = c * side * side;
    for (let y = 0; y < side; y++) {
      const row = from + y * side;
      for (let x = 0; x < side; x++) {
        const here = planes[row + x];
        const left = planes[row + (x ? x - 1 : 0)];
        const right = planes[row + (x < side - 1 ? x + 1 : x)];
        rows[y * wide + 2 * x] = 0.75 * here + 0.25 * left;
        rows[y * wide + 2 * x + 1] = 0.75 * here + 0.25 * right;
      }
    }
    for (let y = 0; y < side; y++) {
      const here = y * wide;
      const above = (y ? y - 1 : 0) * wide;
      const below = (y < side - 1 ? y + 1 : y) * wide;
      const to = c * wide * wide + 2 * y * wide;
      for (let x = 0; x < wide; x++) {
        result[to + x] = 0.75 * rows[here + x] + 0.25 * rows[above + x];
        result[to + wide + x] = 0.75 * rows[here + x] + 0.25 * rows[below + x];
      }
    }
  }
  return result;
}

// The mean of blocks of `factor` x `factor` pixels.
function averaged(planes, count, side, factor) {
  const small = side / factor;
  const result = new Float32Array(count * small * small);
  for (let c = 0; c < count; c++) {
    for (let y = 0; y < side; y++) {
      const to = (c * small + Math.floor(y / factor)) * small;
      const from = (c * side + y) * side;
      for (let x = 0; x < side; x++) result[to + Math.floor(x / factor)] += planes[from + x];
    }
  }
  const share = 1 / (factor * factor);
  for (let i = 0; i < result.length; i++) result[i] *= share;
  return result;
}

// A Gaussian blur whose borders repeat, cut off at four standard deviations, as scipy's.
function gaussian(planes, count, side, sigma) {
  const reach = Math.floor(4 * sigma + 0.5);
  const kernel = Float32Array.from({ length: 2 * reach + 1 }, (_, i) => Math.exp(-0.5 * ((i - reach) / sigma) ** 2));
  const total = kernel.reduce((a, b) => a + b);
  const line = new Float32Array(side + 2 * reach);
  const result = Float32Array.from(planes);
  const blur = (start, step) => {
    for (let i = 0; i < line.length; i++) line[i] = result[start + step * Math.min(side - 1, Math.max(0, i - reach))];
    for (let i = 0; i < side; i++) {
      let sum = 0;
      for (let k = 0; k < kernel.length; k++) sum += kernel[k] * line[i + k];
      result[start + step * i] = sum / total;
    }
  };
  for (let c = 0; c < count; c++) {
    for (let i = 0; i < side; i++) blur((c * side + i) * side, 1);
    for (let i = 0; i < side; i++) blur(c * side * side + i, side);
  }
  return result;
}

// Fill what is not seen [side, side] of planes from around, by push and pull (raster/texture.py).
function inpainted(planes, count, side, seen) {
  const area = side * side;
  if (side === 1) return Float32Array.from(planes, (value) => (seen[0] > 0 ? value : 0));
  const half = Math.ceil(side / 2);
  const weight = new Float32Array(half * half);
  const coarse = new Float32Array(count * half * half);
  for (let y = 0; y < half; y++) {
    for (let x = 0; x < half; x++) {
      const to = y * half + x;
      const rows = 2 * y + 1 < side ? 2 : 1;
      const columns = 2 * x + 1 < side ? 2 : 1;
      for (let dy = 0; dy < rows; dy++) {
        for (let dx = 0; dx < columns; dx++) {
          const from = (2 * y + dy) * side + 2 * x + dx;
          weight[to] += seen[from];
          for (let c = 0; c < count; c++) coarse[c * half * half + to] += planes[c * area + from] * seen[from];
        }
      }
      for (let c = 0; c < count; c++) coarse[c * half * half + to] /= Math.max(weight[to], 1e-12);
      weight[to] = Math.min(1, (4 * weight[to]) / (rows * columns));
    }
  }
  const fill = enlarged(inpainted(coarse, count, half, weight), count, half, side);
  for (let c = 0; c < count; c++) {
    for (let i = 0; i < area; i++) fill[c * area + i] = seen[i] * planes[c * area + i] + (1 - seen[i]) * fill[c * area + i];
  }
  return fill;
}

function enlarged(planes, count, from, to) {
  if (to === 2 * from) return doubled(planes, count, from);
  const result = new Float32Array(count * to * to);
  const scale = from / to;
  for (let y = 0; y < to; y++) {
    for (let x = 0; x < to; x++) {
      for (let c = 0; c < count; c++) {
        result[(c * to + y) * to + x] = sampledAt(planes, c * from * from, from, (x + 0.5) * scale, (y + 0.5) * scale);
      }
    }
  }
  return result;
}

// The bilinear value of a plane that begins at `start`, at (x, y) in its pixels; its border is repeated.
function sampledAt(planes, start, side, x, y) {
  const px = Math.min(side - 1, Math.max(0, x - 0.5));
  const py = Math.min(side - 1, Math.max(0, y - 0.5));
  const column = Math.min(side - 2, Math.floor(px));
  const row = Math.min(side - 2, Math.floor(py));
  if (side === 1) return planes[start];
  const [u, v] = [px - column, py - row];
  const at = start + row * side + column;
  const above = planes[at] + u * (planes[at + 1] - planes[at]);
  const below = planes[at + side] + u * (planes[at + side + 1] - planes[at + side]);
  return above + v * (below - above);
}
