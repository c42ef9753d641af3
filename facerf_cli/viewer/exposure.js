// The exposure of `facerf relight --exposure auto`: the face as bright as in the photo (colour.py).

const LUMINANCE = [0.2126, 0.7152, 0.0722];
const BLACK = 1e-9;
const SHADE = 0.06; // of an exposed ratio, below which its colour fades: there it is noise

class AutoExposure {
  constructor(data) {
    this.about = data.exposure;
    this.skin = this.samples(data.exposure.skin);
    this.person = this.samples(data.exposure.person);
  }

  samples(part) {
    const signed = new Int8Array(bytesOf(part.factors).buffer);
    return { count: part.count, scales: part.scales, factors: signed };
  }

  // EV, to two decimals, of a light with sums [K * 3].
  ev(sums) {
    const [face, most] = [this.skin, this.person].map((part, i) =>
      percentile(this.luminances(part, sums), this.about.percentiles[i]),
    );
    if (Math.min(face, this.about.wanted) <= BLACK) return 0;
    const gain = Math.min(this.about.wanted / face, (2 * Math.max(1, this.about.own)) / Math.max(most, BLACK));
    return Math.round(100 * Math.log2(gain)) / 100;
  }

  luminances(part, sums) {
    const values = new Float32Array(part.count);
    for (let k = 0; k < part.scales.length; k++) {
      const weights = LUMINANCE.map((share, c) => (share * sums[3 * k + c] * part.scales[k]) / 127);
      for (let n = 0; n < part.count; n++) {
        const at = 3 * (k * part.count + n);
        for (let c = 0; c < 3; c++) values[n] += weights[c] * part.factors[at + c];
      }
    }
    return values;
  }
}

function percentile(values, percent) {
  if (!values.length) return 0;
  const sorted = Float32Array.from(values).sort();
  const at = ((sorted.length - 1) * percent) / 100;
  const low = Math.floor(at);
  const high = Math.min(low + 1, sorted.length - 1);
  return sorted[low] + (at - low) * (sorted[high] - sorted[low]);
}

function encoded(linear) {
  const x = Math.min(1, Math.max(0, linear));
  return x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
}

function decoded(value) {
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}
