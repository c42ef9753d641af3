// The relit image without WebGL2: the same sums by the processor, at a smaller size.

const CANVAS_PX = 400; // of the longer side

class CanvasView {
  constructor(canvas, data, images) {
    this.data = data;
    const scale = Math.min(1, CANVAS_PX / Math.max(...data.size));
    [this.width, this.height] = data.size.map((side) => Math.max(1, Math.round(side * scale)));
    [canvas.width, canvas.height] = [this.width, this.height];
    this.context = canvas.getContext("2d");
    this.scale = scale;
    this.detail = this.small(images.detail);
    this.matte = this.small(images.matte);
    this.background = this.small(images.background);
    this.atlas = pixelsOf(images.maps);
    this.atlasWidth = images.maps.width;
  }

  small(image) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [this.width, this.height];
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0, this.width, this.height);
    return context.getImageData(0, 0, this.width, this.height).data;
  }

  draw(sums, ev, withBackground) {
    const ratio = this.summed(sums);
    const gain = this.data.gain * 2 ** ev;
    const shown = this.context.createImageData(this.width, this.height);
    const [mapWidth, mapHeight] = this.data.mapSize;
    const [left, top, width, height] = this.data.box;
    for (let y = 0, i = 0; y < this.height; y++) {
      const row = within(Math.floor((((y + 0.5) / this.scale - top) / height) * mapHeight), mapHeight);
      for (let x = 0; x < this.width; x++, i += 4) {
        const column = within(Math.floor((((x + 0.5) / this.scale - left) / width) * mapWidth), mapWidth);
        const share = this.matte[i] / 255;
        const at = 3 * (row * mapWidth + column);
        const grey = (ratio[at] + ratio[at + 1] + ratio[at + 2]) / 3;
        const colour = limited((grey * gain) / SHADE, 0, 1);
        for (let c = 0; c < 3; c++) {
          const change = Math.max(0, grey + colour * (ratio[at + c] - grey));
          const person = DECODED[this.detail[i + c]] * change * gain;
          const linear = withBackground ? DECODED[this.background[i + c]] + share * person : person;
          shown.data[i + c] = 255 * encoded(linear) + 0.5;
        }
        shown.data[i + 3] = withBackground ? 255 : 255 * share;
      }
    }
    this.context.putImageData(shown, 0, 0);
  }

  // The sum of the maps [h, w, 3].
  summed(sums) {
    const { scales, mapSize, tile, columns } = this.data;
    const [width, height] = mapSize;
    const ratio = new Float32Array(3 * width * height);
    for (let k = 0; k < scales.length; k++) {
      const corner = Math.floor(k / columns) * tile[1] * this.atlasWidth + (k % columns) * tile[0];
      const weights = [0, 1, 2].map((c) => (sums[3 * k + c] * scales[k]) / 127);
      for (let y = 0; y < height; y++) {
        let from = 4 * (corner + y * this.atlasWidth);
        let to = 3 * y * width;
        for (let x = 0; x < width; x++, from += 4, to += 3) {
          for (let c = 0; c < 3; c++) ratio[to + c] += weights[c] * (this.atlas[from + c] - 128);
        }
      }
    }
    return ratio;
  }
}

const DECODED = Float32Array.from({ length: 256 }, (_, value) => decoded(value / 255));

function within(index, size) {
  return Math.min(size - 1, Math.max(0, index));
}
