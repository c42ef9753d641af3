// The exposure of `facerf relight --exposure auto`: the face as bright as in the photo; and its view (colour.py).

const LUMINANCE = [0.2126, 0.7152, 0.0722];
const NOISY = 2; // times the floor of the detail: the luminance below which colours are noise (composite.py)
const BLACK = 1e-9;
const SHOULDER = 0.8; // brightest channel from which on the soft view bends a colour
const WHITENING = 0.3;

class AutoExposure {
  constructor(data, arrays) {
    this.about = data.exposure;
    this.masks = [arrays.skin, arrays.own];
  }

  // EV, to two decimals, of a person [3, side, side] as coarse as the maps, under light of a total luminance.
  ev(relit, strength) {
    const [face, person] = this.masks.map((mask, i) => percentile(luminances(relit, mask), this.about.percentiles[i]));
    if (Math.min(face, this.about.wanted) <= BLACK) return 0;
    const gain = Math.min(this.about.wanted / face, (2 * Math.max(1, this.about.own)) / Math.max(person, BLACK));
    const most = strength > BLACK ? this.about.mostOverFront - Math.log2(strength) : Infinity;
    return Math.round(100 * Math.min(Math.log2(gain), most)) / 100;
  }
}

function luminanceOf(rgb) {
  return LUMINANCE[0] * rgb[0] + LUMINANCE[1] * rgb[1] + LUMINANCE[2] * rgb[2];
}

// Luminance of all of some lights, from wherever they come.
function strengthOf(lights) {
  return lights.reduce((sum, { rgb }) => sum + luminanceOf(rgb), 0);
}

function luminances(planes, mask) {
  const values = [];
  const area = mask.length;
  for (let i = 0; i < area; i++) {
    if (mask[i] > 0.5) values.push(luminanceOf([planes[i], planes[area + i], planes[2 * area + i]]));
  }
  return values;
}

function percentile(values, percent) {
  if (!values.length) return 0;
  const sorted = Float32Array.from(values).sort();
  const at = ((sorted.length - 1) * percent) / 100;
  const low = Math.floor(at);
  const high = Math.min(low + 1, sorted.length - 1);
  return sorted[low] + (at - low) * (sorted[high] - sorted[low]);
}

function softened(colour) {
  const brightest = Math.max(...colour);
  if (brightest <= SHOULDER) return colour;
  const bent = 1 - (1 - SHOULDER) * Math.exp((SHOULDER - brightest) / (1 - SHOULDER));
  const kept = 1 / (1 + WHITENING * (brightest - bent));
  return colour.map((value) => bent + kept * ((value * bent) / brightest - bent));
}

function encoded(linear) {
  const x = Math.min(1, Math.max(0, linear));
  return x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
}

function decoded(value) {
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}
