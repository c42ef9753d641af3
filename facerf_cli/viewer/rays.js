// Shadows of the proxy: rays from each of its visible points to the disc of a light, through a tree of boxes.

const LEAF = 4; // triangles
const DISC_DEG = 3;

class Shadows {
  constructor(arrays, side) {
    this.side = side;
    this.covered = arrays.covered;
    this.count = arrays.origins.length / 3;
    this.origins = arrays.origins;
    this.numbers = arrays.disc; // [rays * 2, N]
    this.rays = this.numbers.length / (2 * this.count);
    this.corners(arrays.vertices, arrays.triangles);
    this.tree();
  }

  // Corner and edges of each triangle [F * 9].
  corners(vertices, triangles) {
    const n = vertices.length / 3;
    this.faces = new Float32Array(3 * triangles.length);
    for (let t = 0; t < triangles.length / 3; t++) {
      const [a, b, c] = [triangles[3 * t], triangles[3 * t + 1], triangles[3 * t + 2]];
      for (let k = 0; k < 3; k++) {
        this.faces[9 * t + k] = vertices[k * n + a];
        this.faces[9 * t + 3 + k] = vertices[k * n + b] - vertices[k * n + a];
        this.faces[9 * t + 6 + k] = vertices[k * n + c] - vertices[k * n + a];
      }
    }
  }

  // Boxes of a binary tree: bounds [6], and the first child or the first triangle with their count.
  tree() {
    const { faces } = this;
    const total = faces.length / 9;
    const order = Array.from({ length: total }, (_, i) => i);
    const middle = (t, k) => faces[9 * t + k] + (faces[9 * t + 3 + k] + faces[9 * t + 6 + k]) / 3;
    this.bounds = new Float32Array(6 * 2 * total);
    this.links = new Int32Array(2 * 2 * total);
    let nodes = 1;
    const pending = [[0, 0, total]];
    while (pending.length) {
      const [node, first, last] = pending.pop();
      const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
      for (let i = first; i < last; i++) {
        for (let k = 0; k < 3; k++) {
          const a = faces[9 * order[i] + k];
          const b = a + faces[9 * order[i] + 3 + k];
          const c = a + faces[9 * order[i] + 6 + k];
          box[k] = Math.min(box[k], a, b, c);
          box[3 + k] = Math.max(box[3 + k], a, b, c);
        }
      }
      this.bounds.set(box, 6 * node);
      if (last - first <= LEAF) {
        this.links.set([first, last - first], 2 * node);
        continue;
      }
      const sides = [0, 1, 2].map((k) => box[3 + k] - box[k]);
      const axis = sides.indexOf(Math.max(...sides));
      const part = order.slice(first, last).sort((a, b) => middle(a, axis) - middle(b, axis));
      for (let i = first; i < last; i++) order[i] = part[i - first];
      const half = (first + last) >> 1;
      this.links.set([nodes, 0], 2 * node);
      pending.push([nodes, first, half], [nodes + 1, half, last]);
      nodes += 2;
    }
    const sorted = new Float32Array(faces.length);
    order.forEach((t, i) => sorted.set(faces.subarray(9 * t, 9 * t + 9), 9 * i));
    this.faces = sorted;
    this.stack = new Int32Array(64);
  }

  // Share [side, side] of a light from a direction that reaches each pixel.
  visibility(toward) {
    const found = new Float32Array(this.count);
    const [tangent, bitangent] = tangentsOf(toward);
    const radius = Math.tan(DISC_DEG * DEGREE);
    for (let ray = 0; ray < this.rays; ray++) {
      const shares = this.numbers.subarray(2 * ray * this.count, (2 * ray + 1) * this.count);
      const turns = this.numbers.subarray((2 * ray + 1) * this.count, (2 * ray + 2) * this.count);
      for (let i = 0; i < this.count; i++) {
        const r = radius * Math.sqrt(shares[i]);
        const [u, v] = [r * Math.cos(2 * Math.PI * turns[i]), r * Math.sin(2 * Math.PI * turns[i])];
        const x = toward[0] + u * tangent[0] + v * bitangent[0];
        const y = toward[1] + u * tangent[1] + v * bitangent[1];
        const z = toward[2] + u * tangent[2] + v * bitangent[2];
        if (!this.blocked(i, x, y, z)) found[i] += 1 / this.rays;
      }
    }
    const whole = new Float32Array(this.side * this.side);
    for (let i = 0, at = 0; i < whole.length; i++) if (this.covered[i] > 0) whole[i] = found[at++];
    return gaussian(inpainted(whole, 1, this.side, this.covered), 1, this.side, 0.7);
  }

  blocked(index, dx, dy, dz) {
    const { bounds, links, stack, faces, origins, count } = this;
    const [ox, oy, oz] = [origins[index], origins[count + index], origins[2 * count + index]];
    const [ix, iy, iz] = [1 / (dx || 1e-30), 1 / (dy || 1e-30), 1 / (dz || 1e-30)];
    let top = 0;
    stack[top++] = 0;
    while (top) {
      const node = stack[--top];
      const b = 6 * node;
      let near = 0;
      let far = Infinity;
      let t0 = (bounds[b] - ox) * ix;
      let t1 = (bounds[b + 3] - ox) * ix;
      if (t0 < t1) { if (t0 > near) near = t0; if (t1 < far) far = t1; }
      else { if (t1 > near) near = t1; if (t0 < far) far = t0; }
      t0 = (bounds[b + 1] - oy) * iy;
      t1 = (bounds[b + 4] - oy) * iy;
      if (t0 < t1) { if (t0 > near) near = t0; if (t1 < far) far = t1; }
      else { if (t1 > near) near = t1; if (t0 < far) far = t0; }
      t0 = (bounds[b + 2] - oz) * iz;
      t1 = (bounds[b + 5] - oz) * iz;
      if (t0 < t1) { if (t0 > near) near = t0; if (t1 < far) far = t1; }
      else { if (t1 > near) near = t1; if (t0 < far) far = t0; }
      if (near > far) continue;
      const leaf = links[2 * node + 1];
      if (!leaf) {
        stack[top++] = links[2 * node];
        stack[top++] = links[2 * node] + 1;
        continue;
      }
      for (let t = 9 * links[2 * node], end = t + 9 * leaf; t < end; t += 9) {
        const [e1x, e1y, e1z] = [faces[t + 3], faces[t + 4], faces[t + 5]];
        const [e2x, e2y, e2z] = [faces[t + 6], faces[t + 7], faces[t + 8]];
        const px = dy * e2z - dz * e2y;
        const py = dz * e2x - dx * e2z;
        const pz = dx * e2y - dy * e2x;
        const inverse = 1 / (e1x * px + e1y * py + e1z * pz);
        const [sx, sy, sz] = [ox - faces[t], oy - faces[t + 1], oz - faces[t + 2]];
        const u = (sx * px + sy * py + sz * pz) * inverse;
        if (!(u >= 0 && u <= 1)) continue;
        const qx = sy * e1z - sz * e1y;
        const qy = sz * e1x - sx * e1z;
        const qz = sx * e1y - sy * e1x;
        const v = (dx * qx + dy * qy + dz * qz) * inverse;
        if (v >= 0 && u + v <= 1 && (e2x * qx + e2y * qy + e2z * qz) * inverse > 0) return true;
      }
    }
    return false;
  }
}

// Two unit vectors orthogonal to a direction (light/transport.py).
function tangentsOf(toward) {
  const raw = cross(Math.abs(toward[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], toward);
  const length = Math.hypot(...raw);
  const tangent = raw.map((value) => value / length);
  return [tangent, cross(toward, tangent)];
}
