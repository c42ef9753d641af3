// Lights and maps as weights of the lights of an OLAT stack.
// Conventions are facerf's (docs/design.md): azimuth > 0 lights the image's right side, elevation > 0 from above.

const DEGREE = Math.PI / 180;
const MAP_ROWS = 256; // of the grid on which the cells of the lights are found

const byId = (id) => document.getElementById(id);
const limited = (value, low, high) => Math.min(high, Math.max(low, value));
const turned = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const luminance = (rgb) => 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
const decoded = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
const encoded = (x) => (x <= 0.0031308 ? 12.92 * Math.max(0, x) : 1.055 * Math.min(1, x) ** (1 / 2.4) - 0.055);
const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
const floatsOf = (base64) => new Float32Array(bytesOf(base64).buffer);
const groups = (flat, size) => Array.from({ length: flat.length / size }, (_, i) => flat.subarray(size * i, size * (i + 1)));
const scaled = (weights, scales) => weights.map((value, i) => value * scales[Math.floor(i / 3)]);

function directionOf(azimuth, elevation) {
  const ring = Math.cos(elevation * DEGREE);
  return [ring * Math.sin(azimuth * DEGREE), Math.sin(elevation * DEGREE), ring * Math.cos(azimuth * DEGREE)];
}

class Rig {
  constructor(data) {
    this.lights = groups(floatsOf(data.directions), 3);
    this.triangles = groups(new Uint16Array(bytesOf(data.triangles).buffer), 3);
    this.shares = floatsOf(data.shares); // a matrix [3, 3] for each triangle, from a direction to its shares
  }

  nearest(toward) {
    const cosines = this.lights.map((light) => dot(light, toward));
    return cosines.indexOf(Math.max(...cosines));
  }

  // Lights around a direction and their shares; the nearest one where no triangle is.
  around(toward) {
    const share = (row) => this.shares[row] * toward[0] + this.shares[row + 1] * toward[1] + this.shares[row + 2] * toward[2];
    for (const [t, lights] of this.triangles.entries()) {
      const [a, b, c] = [share(9 * t), share(9 * t + 3), share(9 * t + 6)];
      const total = a + b + c;
      if (Math.min(a, b, c) >= -1e-4 && total > 0) return [a, b, c].map((one, i) => [lights[i], one / total]);
    }
    return [[this.nearest(toward), 1]];
  }

  // Lights around directions that have shares, and theirs.
  sharesOf(samples) {
    return samples.flatMap(([toward, part]) => this.around(toward).map(([i, share]) => [i, part * share]));
  }

  // Weights [lights * 3] under a turned map: its integral over the directions nearest to each light, over pi.
  mapWeights(map, degrees) {
    const [weights, step] = [new Float64Array(3 * this.lights.length), 180 / MAP_ROWS];
    this.cells ??= Uint16Array.from({ length: 2 * MAP_ROWS * MAP_ROWS }, (_, i) => {
      const [row, column] = [Math.floor(i / (2 * MAP_ROWS)), i % (2 * MAP_ROWS)];
      return this.nearest(directionOf(180 - step * (column + 0.5), 90 - step * (row + 0.5)));
    });
    this.cells.forEach((light, i) => {
      const [row, column] = [Math.floor(i / (2 * MAP_ROWS)), i % (2 * MAP_ROWS)];
      const radiance = map.at((step * (column + 0.5) + degrees) / 360, (row + 0.5) / MAP_ROWS);
      const band = Math.sin((90 - step * row) * DEGREE) - Math.sin((90 - step * (row + 1)) * DEGREE);
      for (let c = 0; c < 3; c++) weights[3 * light + c] += (radiance[c] * band) / MAP_ROWS;
    });
    return weights;
  }
}

// A lat-long map [height, width, 3]; a large one is averaged down to the rows of the grid.
class LatLong {
  constructor({ name, size, pixels, command = "", path = name }) {
    const [[width, height], rows] = [size, Math.min(size[1], MAP_ROWS)];
    Object.assign(this, { name, command, path, width: 2 * rows, height: rows });
    this.pixels = new Float32Array(6 * rows * rows);
    const counts = new Uint32Array(2 * rows * rows);
    for (let i = 0; i < width * height; i++) {
      const to = this.index(((i % width) + 0.5) / width, (Math.floor(i / width) + 0.5) / height);
      counts[to]++;
      for (let c = 0; c < 3; c++) this.pixels[3 * to + c] += pixels[3 * i + c];
    }
    for (let i = 0; i < this.pixels.length; i++) this.pixels[i] /= counts[Math.floor(i / 3)];
  }

  index(u, v) {
    return Math.floor(v * this.height) * this.width + Math.min(this.width - 1, Math.floor(u * this.width));
  }

  // The radiance at (u, v); u is in turns.
  at(u, v) {
    const from = 3 * this.index(u - Math.floor(u), v);
    return this.pixels.subarray(from, from + 3);
  }
}
