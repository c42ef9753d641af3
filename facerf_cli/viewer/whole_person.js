// All that a page knows of a photo's light: the person and the face under lights and a map, and their exposure.

const FEATHER = 0.12; // border of the square where the change of light takes over, in halves of its side
const STRAND_RANGE = [0.3, 3];
const FACTORED_SHARE = 0.05; // of a map's light, for which the factors are good enough
const SLICE_MS = 30; // of work between two frames
const SETTLE_MS = 120; // after a change, before the decoder starts

class LightField {
  constructor(data, arrays, images, say) {
    this.rig = new Rig(data.stage);
    this.portrait = new Portrait(data, arrays);
    this.face = new Face(data, arrays, images.maps, this.rig);
    this.auto = new AutoExposure(data, arrays);
    this.say = say;
    this.stage = []; // the portrait under each light of the stage, made when a map is first chosen
    this.faces = []; // textures of the face under those lights, as far as maps needed them
    this.decoded = 0;
  }

  // The light of all pixels under lights {toward, rgb} and a map, and whether it is exact or a first guess.
  under(lights, map, degrees, mapGain) {
    const lit = this.portrait.sum(lights.map(({ toward, rgb }) => ({ single: this.portrait.single(toward), rgb })));
    const faces = lights.map(({ toward, rgb }) => ({ known: this.face.decoded(toward), toward, rgb }));
    const own = map ? this.underMap(map, degrees) : null;
    if (own) for (let i = 0; i < lit.length; i++) lit[i] += mapGain * own.lit[i];
    const texture = this.face.neural(faces, own, mapGain);
    this.face.blended(texture, lit);
    const ev = this.auto.ev(this.portrait.relit(lit), strengthOf(lights) + mapGain * (own?.strength ?? 0));
    const exact = faces.every(({ known }) => known) && (!map || Boolean(own?.exact));
    return { ...this.portrait.wide(lit), texture, ...this.face.changes(texture), ev, exact };
  }

  // Shading, highlights and the face's texture under a map, kept until something of it changes; null before the
  // portrait under the stage's lights is known.
  underMap(map, degrees) {
    if (this.stage.length < this.rig.lights) return null;
    const { last } = this;
    if (last?.map === map && last.degrees === degrees && last.decoded === this.decoded) return last;
    const weights = this.rig.weights(map, degrees);
    const lights = this.stage.map((single, i) => ({ single, rgb: weights.subarray(3 * i, 3 * i + 3) }));
    const wanted = this.strongest(lights);
    const texture = this.face.ofStage(lights, this.faces);
    const exact = wanted.every((light) => this.faces[light]);
    const strength = strengthOf(lights);
    this.last = { map, degrees, decoded: this.decoded, wanted, exact, strength, lit: this.portrait.sum(lights), texture };
    return this.last;
  }

  // The lights of the stage that give all but a little of a map's light; the factors are good enough for the rest.
  strongest(lights) {
    const shares = lights.map(({ single, rgb }) => (rgb[0] + rgb[1] + rgb[2]) * single.brightness);
    let left = shares.reduce((a, b) => a + b) * FACTORED_SHARE;
    const order = shares.map((_, i) => i).sort((a, b) => shares[a] - shares[b]);
    return order.filter((light) => (left -= shares[light]) < 0).reverse();
  }

  // Make what is missing for an exact image in small slices, then call `done`. A later call replaces this one.
  refine(lights, map, degrees, done) {
    clearTimeout(this.timer);
    const work = this.missing(lights, map, degrees);
    const step = () => {
      const until = performance.now() + SLICE_MS;
      while (performance.now() < until) if (work.next().done) return done();
      this.timer = setTimeout(step);
    };
    this.timer = setTimeout(step, SETTLE_MS);
  }

  *missing(lights, map, degrees) {
    while (map && this.stage.length < this.rig.lights) {
      const toward = this.rig.toward(this.stage.length);
      this.stage.push(this.portrait.corrected(...this.portrait.shaded(toward)));
      this.say(`Preparing maps: ${Math.round((100 * this.stage.length) / this.rig.lights)} %`);
      yield;
    }
    for (const { toward } of lights) if (!this.face.decoded(toward)) yield* this.face.decode(toward);
    const open = map ? this.underMap(map, degrees).wanted.filter((light) => !this.faces[light]) : [];
    for (const [done, light] of open.entries()) {
      this.say(`Refining the face: ${Math.round((100 * done) / open.length)} %`);
      this.faces[light] = yield* this.face.decoder.texture(this.rig.toward(light));
      this.decoded++;
    }
    this.say("");
  }
}
