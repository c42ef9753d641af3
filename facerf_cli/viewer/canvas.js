// The relit image without WebGL2: the same formulas by the processor, at a smaller size.

const CANVAS_PX = 400; // of the longer side

class CanvasView {
  constructor(canvas, data, arrays, images) {
    Object.assign(this, { data, arrays });
    const scale = Math.min(1, CANVAS_PX / Math.max(...data.size));
    this.scale = scale;
    [this.width, this.height] = data.size.map((side) => Math.max(1, Math.round(side * scale)));
    [canvas.width, canvas.height] = [this.width, this.height];
    this.context = canvas.getContext("2d");
    this.bytes = ["photo", "fringe", "matte"].map((name) => pixelsOf(images[name]));
    this.facePx = Math.sqrt(arrays.faceTexture.length / 3);
  }

  light(lit) {
    this.lit = lit;
  }

  draw(withBackground) {
    const shown = this.context.createImageData(this.width, this.height);
    for (let y = 0, to = 0; y < this.height; y++) {
      for (let x = 0; x < this.width; x++, to += 4) {
        const at = [x, y].map((value, i) => Math.min(this.data.size[i] - 1, Math.floor((value + 0.5) / this.scale)));
        shown.data.set(this.pixel(...at, withBackground), to);
      }
    }
    this.context.putImageData(shown, 0, 0);
  }

  // The bytes [4] of a pixel of the photo.
  pixel(x, y, withBackground) {
    const [photo, fringe, matte] = this.bytes;
    const from = 4 * (y * this.data.size[0] + x);
    const share = matte[from] / 255;
    const plate = [0, 1, 2].map((c) => DECODED[photo[from + c]]);
    const own = share > 0 && share < 1 ? [0, 1, 2].map((c) => DECODED[fringe[from + c]]) : plate;
    const person = this.withFace(this.person(own, x + 0.5, y + 0.5), own, x, y);
    const mixed = withBackground ? plate.map((value, c) => value + share * (person[c] - own[c])) : person;
    const soft = softened(mixed);
    const bends = withBackground ? share : 1;
    const bytes = mixed.map((value, c) => 255 * encoded(value + bends * (soft[c] - value)));
    return [...bytes, withBackground ? 255 : 255 * share];
  }

  person(own, x, y) {
    const { person } = this.data;
    const { side } = person;
    const area = side * side;
    const [u, v] = [(x - person.square[0]) / person.square[2], (y - person.square[1]) / person.square[2]];
    const fine = (planes, c) => sampledAt(planes, c * area, side, u * side, v * side);
    const lines = this.arrays.albedoLines;
    const guide = own.map((value) => Math.round(255 * encoded(value * person.guideGain)) / 255);
    const albedo = own.map((value, c) => {
      const gain = guide.reduce((sum, shown, k) => sum + shown * fine(lines, 3 * c + k), fine(lines, 9 + c));
      return (value / person.personExposure) * Math.exp(limited(gain, ...person.gainRange)) + fine(lines, 12 + c);
    });
    const mean = (albedo[0] + albedo[1] + albedo[2]) / 3;
    const finer = limited(mean / Math.max(fine(this.arrays.hair, 0), 1e-4), ...STRAND_RANGE);
    const strands = 1 + fine(this.arrays.hair, 1) * (finer - 1);
    const inside = limited((1 - Math.max(Math.abs(2 * u - 1), Math.abs(2 * v - 1))) / FEATHER, 0, 1);
    const { lit, change, gain } = this.lit;
    const blocks = Math.sqrt(change.length / 3);
    return own.map((value, c) => {
      const radiance = (albedo[c] * fine(lit, c) + strands * fine(lit, 3 + c)) * person.exposure;
      const beyond = value * sampledAt(change, c * blocks * blocks, blocks, blockAt(u, side), blockAt(v, side));
      return gain * (beyond + inside * (radiance - beyond));
    });
  }

  withFace(person, own, x, y) {
    const [left, top, width, height] = this.data.window;
    const [column, row] = [x - left, y - top];
    if (column < 0 || row < 0 || column >= width || row >= height) return person;
    const { window, faceTexture, ownDetail } = this.arrays;
    const at = row * width + column;
    const mask = window[2 * width * height + at] / 65535;
    if (!mask) return person;
    const px = this.facePx;
    const [u, v] = [(window[at] / 65535) * px, (window[width * height + at] / 65535) * px];
    const texel = (planes, c) => sampledAt(planes, c * px * px, px, u, v);
    const { texture, around, mean, gain } = this.lit;
    const floor = this.data.person.detailFloor;
    const kept = texel(ownDetail, 0);
    const sources = own.map((_, c) => texel(faceTexture, c));
    const lightness = luminanceOf(own);
    const noise = Math.max(1 - lightness / (NOISY * floor), 0);
    const scale = lightness / Math.max(luminanceOf(sources), 1e-8);
    return own.map((value, c) => {
      const source = sources[c];
      const steady = value + noise * (source * scale - value);
      const skin = texel(texture, c);
      const relit =
        value >= source
          ? (skin * (value + floor)) / (source + floor) + (mean[c] * floor * (value - source)) / (source + floor)
          : skin * (steady / Math.max(source, 1e-8) + (value - steady) / (source + floor));
      const detailed = gain * (relit + kept * (texel(around, c) * value - relit));
      return person[c] + mask * (detailed - person[c]);
    });
  }
}

const DECODED = Float32Array.from({ length: 256 }, (_, value) => decoded(value / 255));
