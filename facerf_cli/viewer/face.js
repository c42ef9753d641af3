// Textures of the face: of single lights by the decoder, of maps by factors; mixed with the portrait's.

const PORTRAIT_SHARE = 0.4; // in the face, where the decoder's texture is finer
const FACTOR_ERROR = 4; // of the factors' texels, in steps of their bytes; where it drowns the light, none of it is seen

class Face {
  constructor(data, arrays, atlas, rig) {
    Object.assign(this, data.person);
    this.stage = data.stage;
    this.arrays = arrays;
    this.atlas = pixelsOf(atlas);
    this.atlasWidth = atlas.width;
    this.rig = rig;
    this.decoder = new Decoder(data, arrays);
    this.px = this.decoder.texturePx;
    this.texels = this.px * this.px;
    this.known = new Map();
    this.around = inpainted(arrays.faceTexture, 3, this.px, arrays.trusted);
    for (let i = 0; i < this.around.length; i++) this.around[i] = Math.max(this.around[i], this.detailFloor);
    this.trustedSum = arrays.trusted.reduce((a, b) => a + b);
  }

  // The texture of a light of rgb 1 if the decoder has made it.
  decoded(toward) {
    return this.known.get(toward.join());
  }

  // Decode a light step by step; the last step keeps its texture.
  *decode(toward) {
    const texture = yield* this.decoder.texture(toward);
    if (this.known.size > 2 * MOST_LIGHTS) this.known.delete(this.known.keys().next().value);
    this.known.set(toward.join(), texture);
  }

  // The texture [3, T, T] of lights {known, toward, rgb}, by the factors where it is not known, and under a map.
  neural(lights, map, mapGain) {
    const texture = new Float32Array(3 * this.texels);
    if (map) for (let i = 0; i < texture.length; i++) texture[i] = mapGain * map.texture[i];
    const sums = new Float32Array(3 * this.rig.rank);
    for (const { known, toward, rgb } of lights) {
      if (known) this.addTexture(texture, known, rgb);
      else this.rig.coefficients(toward).forEach((value, k) => rgb.forEach((share, c) => (sums[3 * k + c] += share * value)));
    }
    this.noise = 0;
    if (lights.some(({ known }) => !known)) {
      this.addFactors(texture, sums);
      this.noise = this.noiseOf(sums);
    }
    return texture;
  }

  // The texture [3, T, T] under lights {rgb} of the stage, of which some textures are known.
  ofStage(lights, known) {
    const texture = new Float32Array(3 * this.texels);
    lights.forEach(({ rgb }, i) => known[i] && this.addTexture(texture, known[i], rgb));
    this.addFactors(texture, this.rig.sums(lights.flatMap(({ rgb }, i) => (known[i] ? [0, 0, 0] : [...rgb]))));
    return texture;
  }

  addTexture(texture, known, rgb) {
    for (let c = 0; c < 3; c++) {
      for (let i = c * this.texels; i < (c + 1) * this.texels; i++) texture[i] += rgb[c] * known[i];
    }
  }

  addFactors(texture, sums) {
    const { scales, tile, columns } = this.stage;
    const { px, texels, atlas } = this;
    for (let k = 0; k < scales.length; k++) {
      const corner = Math.floor(k / columns) * tile[1] * this.atlasWidth + (k % columns) * tile[0];
      const [r, g, b] = [0, 1, 2].map((c) => (sums[3 * k + c] * scales[k]) / 127);
      for (let y = 0; y < px; y++) {
        let from = 4 * (corner + y * this.atlasWidth);
        for (let i = y * px; i < (y + 1) * px; i++, from += 4) {
          texture[i] += r * (atlas[from] - 128);
          texture[texels + i] += g * (atlas[from + 1] - 128);
          texture[2 * texels + i] += b * (atlas[from + 2] - 128);
        }
      }
    }
  }

  // The standard deviation of a texture's noise where the factors guess it.
  noiseOf(sums) {
    const { scales } = this.stage;
    const power = sums.reduce((total, value, i) => total + (value * scales[Math.floor(i / 3)]) ** 2 / 3, 0);
    return (FACTOR_ERROR * Math.sqrt(power)) / 127;
  }

  // That texture mixed with the portrait's under shading and highlights [6, side, side].
  blended(texture, lit) {
    const { texels, side } = this;
    const { faceAlbedo } = this.arrays;
    const places = this.arrays.texels;
    for (let i = 0; i < texels; i++) {
      const [x, y] = [((places[i] + 1) / 2) * side, ((places[texels + i] + 1) / 2) * side];
      for (let c = 0; c < 3; c++) {
        const at = c * texels + i;
        const shading = sampledAt(lit, c * side * side, side, x, y);
        const shine = sampledAt(lit, (3 + c) * side * side, side, x, y);
        const own = (faceAlbedo[at] * shading + shine) * this.exposure;
        const drowned = Math.min(1, (this.noise / Math.max(own, texture[at], 1e-9)) ** 2); // by noise, as lights from behind are
        texture[at] += (PORTRAIT_SHARE + (1 - PORTRAIT_SHARE) * drowned) * (own - texture[at]);
      }
    }
    return texture;
  }

  // What eyes, brows and teeth follow: the change of the skin around them [3, T, T], and its mean [3].
  changes(texture) {
    const { trusted } = this.arrays;
    const around = inpainted(texture, 3, this.px, trusted);
    for (let i = 0; i < around.length; i++) around[i] /= this.around[i];
    const mean = this.meanSource.map((source, c) => {
      let sum = 0;
      for (let i = 0; i < this.texels; i++) sum += trusted[i] * texture[c * this.texels + i];
      return sum / Math.max(this.trustedSum, 1e-8) / Math.max(source, 1e-8);
    });
    return { around, mean };
  }
}
