// Directions of light, and the coefficients of lights and maps over the rig.
// Conventions are facerf's (docs/design.md): azimuth > 0 lights the image's right side, elevation > 0 from above.

const DEGREE = Math.PI / 180;
const MAP_ROWS = 256; // of the grid on which the cells of the stage's lights are found

function directionOf(azimuth, elevation) {
  const ring = Math.cos(elevation * DEGREE);
  return [ring * Math.sin(azimuth * DEGREE), Math.sin(elevation * DEGREE), ring * Math.cos(azimuth * DEGREE)];
}

function azimuthElevation([x, y, z]) {
  return [Math.atan2(x, z) / DEGREE, Math.atan2(y, Math.hypot(x, z)) / DEGREE];
}

// The stage: the lights over which maps are integrated, and coefficients of its factored textures.
class Rig {
  constructor(stage) {
    this.rank = stage.scales.length;
    this.stage = floatsOf(stage.directions);
    this.table = floatsOf(stage.coefficients);
    this.planes = this.inverses(wordsOf(stage.triangles));
    this.lights = this.stage.length / 3;
  }

  // The unit direction of a light of the stage.
  toward(light) {
    return Array.from(this.stage.subarray(3 * light, 3 * light + 3));
  }

  // For each triangle its corners, and the inverse of the matrix of their directions.
  inverses(triangles) {
    const found = [];
    for (let t = 0; t < triangles.length; t += 3) {
      const corners = Array.from(triangles.subarray(t, t + 3));
      const [a, b, c] = corners.map((i) => this.toward(i));
      const rows = [cross(b, c), cross(c, a), cross(a, b)];
      const volume = dot(a, rows[0]);
      found.push({ corners, rows: rows.map((row) => row.map((x) => x / volume)) });
    }
    return found;
  }

  // Coefficients [K] of a unit direction: those of a triangle's corners, weighted by its shares of them.
  coefficients(toward) {
    let best = null;
    let least = -Infinity;
    for (const plane of this.planes) {
      const shares = plane.rows.map((row) => dot(row, toward));
      const lowest = Math.min(...shares);
      if (lowest > least) {
        [best, least] = [{ plane, shares }, lowest];
        if (lowest >= 0) break;
      }
    }
    const total = best.shares.reduce((a, b) => a + b);
    const sum = new Float32Array(this.rank);
    best.plane.corners.forEach((corner, i) => {
      const share = best.shares[i] / total;
      for (let k = 0; k < this.rank; k++) sum[k] += share * this.table[corner * this.rank + k];
    });
    return sum;
  }

  // Sums [K * 3] of a map's weights [lights * 3].
  sums(weights) {
    const sums = new Float32Array(3 * this.rank);
    for (let i = 0; i < this.lights; i++) {
      for (let k = 0; k < this.rank; k++) {
        const own = this.table[i * this.rank + k];
        for (let c = 0; c < 3; c++) sums[3 * k + c] += own * weights[3 * i + c];
      }
    }
    return sums;
  }

  // Index of the stage's light that is nearest to each texel of a grid, found once.
  get cells() {
    if (!this.found) {
      this.found = new Uint16Array(2 * MAP_ROWS * MAP_ROWS);
      for (let row = 0; row < MAP_ROWS; row++) {
        for (let column = 0; column < 2 * MAP_ROWS; column++) {
          const toward = directionOf(180 - (360 * (column + 0.5)) / (2 * MAP_ROWS), 90 - (180 * (row + 0.5)) / MAP_ROWS);
          this.found[row * 2 * MAP_ROWS + column] = this.nearest(toward);
        }
      }
    }
    return this.found;
  }

  nearest([x, y, z]) {
    let best = 0;
    let most = -2;
    for (let i = 0; i < this.lights; i++) {
      const cosine = x * this.stage[3 * i] + y * this.stage[3 * i + 1] + z * this.stage[3 * i + 2];
      if (cosine > most) [best, most] = [i, cosine];
    }
    return best;
  }

  // Weights [lights * 3] of the stage under a map that is rotated by `degrees`: its integral over each cell, over pi.
  weights(map, degrees) {
    const weights = new Float64Array(3 * this.lights);
    const width = 2 * MAP_ROWS;
    for (let row = 0; row < MAP_ROWS; row++) {
      const band = Math.sin((0.5 - row / MAP_ROWS) * Math.PI) - Math.sin((0.5 - (row + 1) / MAP_ROWS) * Math.PI);
      const edges = map.upTo(row, degrees);
      for (let column = 0; column < width; column++) {
        const at = 3 * this.cells[row * width + column];
        for (let c = 0; c < 3; c++) {
          const mean = edges[3 * column + 3 + c] - edges[3 * column + c];
          weights[at + c] += (mean * band * 2 * Math.PI) / Math.PI;
        }
      }
    }
    return weights;
  }
}

// A lat-long map [height, width, 3], averaged down to the rows of the grid.
class LatLong {
  constructor(name, width, height, pixels, command = "", path = name) {
    Object.assign(this, { name, command, path });
    [this.width, this.height] = [width, height];
    this.pixels = pixels;
    while (this.height > MAP_ROWS && this.height % 2 === 0 && this.width % 2 === 0) this.halve();
    this.cumulative = this.integrals();
  }

  halve() {
    const [width, height] = [this.width / 2, this.height / 2];
    const small = new Float32Array(3 * width * height);
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        for (let c = 0; c < 3; c++) {
          const at = (row, column) => this.pixels[3 * ((2 * y + row) * this.width + 2 * x + column) + c];
          small[3 * (y * width + x) + c] = (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1)) / 4;
        }
      }
    }
    Object.assign(this, { width, height, pixels: small });
  }

  // For each row the sum of pixels to the left of each edge, as a share of a turn.
  integrals() {
    const sums = new Float64Array(3 * this.height * (this.width + 1));
    for (let y = 0; y < this.height; y++) {
      for (let x = 0; x < this.width; x++) {
        const from = 3 * (y * (this.width + 1) + x);
        for (let c = 0; c < 3; c++) {
          sums[from + 3 + c] = sums[from + c] + this.pixels[3 * (y * this.width + x) + c] / this.width;
        }
      }
    }
    return sums;
  }

  // Those sums at the edges of the grid's columns [(2 rows + 1) * 3] in one of its rows, of the rotated map.
  upTo(row, degrees) {
    const y = Math.min(this.height - 1, Math.floor(((row + 0.5) / MAP_ROWS) * this.height));
    const start = 3 * y * (this.width + 1);
    const edges = new Float64Array(3 * (2 * MAP_ROWS + 1));
    for (let column = 0; column <= 2 * MAP_ROWS; column++) {
      const u = column / (2 * MAP_ROWS) + degrees / 360; // u decreases with azimuth
      const turns = Math.floor(u);
      const position = (u - turns) * this.width;
      const pixel = Math.min(this.width - 1, Math.floor(position));
      for (let c = 0; c < 3; c++) {
        const before = this.cumulative[start + 3 * pixel + c];
        const after = this.cumulative[start + 3 * pixel + 3 + c];
        const turn = this.cumulative[start + 3 * this.width + c];
        edges[3 * column + c] = before + (position - pixel) * (after - before) + turns * turn;
      }
    }
    return edges;
  }

  // The radiance in a direction, without interpolation.
  look([x, y, z], degrees) {
    const [azimuth, elevation] = azimuthElevation([x, y, z]);
    const u = 0.5 - (azimuth - degrees) / 360;
    const column = Math.floor((u - Math.floor(u)) * this.width) % this.width;
    const row = Math.min(this.height - 1, Math.floor((0.5 - elevation / 180) * this.height));
    const at = 3 * (row * this.width + column);
    return [this.pixels[at], this.pixels[at + 1], this.pixels[at + 2]];
  }
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
