// Lights as --light takes them (docs/lights.md), their colours and the samples of soft ones, as facerf has them.

const MOST_LIGHTS = 9;
const WHITE_K = 6504; // of D65
const [APART_DEG, MOST_A_SIDE] = [6, 6]; // samples of a soft light (light/light.py)
const XYZ_TO_RGB = [[3.2404542, -1.5371385, -0.4985314], [-0.969266, 1.8760108, 0.041556], [0.0556434, -0.2040259, 1.0572252]];
const [AMBIENT, ORIGINAL] = ["ambient", "original"]; // names of the ambient fill and of the original light
// Numbers of the keys of a light, and their limits; those of a page, and others of --light, which it cannot show.
const KEYS = {
  at: [3, -1e4, 1e4], from: [2, -1e5, 1e5], rgb: [3, 0, 1e6], kelvin: [1, 1667, 25000], stops: [1, -20, 20],
  size: [1, 0, 10], size_deg: [1, 0, 120],
};
const OTHER_KEYS = ["map", "rotate", "spot", "face"];

const newLight = (values) => ({ name: "", azimuth: 0, elevation: 0, uniform: false, original: false, rgb: [1, 1, 1], kelvin: WHITE_K, stops: 0, size: 0, ...values });
const isName = (text) => /^[A-Za-z][\w-]*$/.test(text) && !Object.hasOwn(KEYS, text) && ![...OTHER_KEYS, "name"].includes(text);
const numbersIn = (text) => text.split(",").map((part) => (part.trim() ? Number(part) : NaN));
const rounded = (value, digits) => Number(value.toFixed(digits));
const cross = (a, b) => [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
const ofLength1 = (a) => a.map((value) => value / Math.hypot(...a));
const towards = (azimuth, elevation) => ({ azimuth: turned(azimuth), elevation: limited(elevation, -90, 90) });

function azelOf([x, y, z]) {
  return towards(Math.atan2(x, z) / DEGREE, Math.asin(limited(y / (Math.hypot(x, y, z) || 1), -1, 1)) / DEGREE);
}

// Linear rgb [3] of the Planckian locus, by Kang et al. 2002.
function planckian(kelvin) {
  const t = 1000 / kelvin;
  const x = kelvin <= 4000
    ? ((-0.2661239 * t - 0.2343589) * t + 0.8776956) * t + 0.17991
    : ((-3.0258469 * t + 2.1070379) * t + 0.2226347) * t + 0.24039;
  const y = kelvin <= 2222
    ? ((-1.1063814 * x - 1.3481102) * x + 2.18555832) * x - 0.20219683
    : kelvin <= 4000
      ? ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
      : ((3.081758 * x - 5.8733867) * x + 3.75112997) * x - 0.37001483;
  return XYZ_TO_RGB.map((row) => dot(row, [x / y, 1, (1 - x - y) / y]));
}

// Linear rgb [3] of a blackbody, of luminance 1; 1, 1, 1 at WHITE_K.
function blackbody(kelvin) {
  const white = planckian(WHITE_K);
  const rgb = planckian(kelvin).map((value, c) => Math.max(0, value / white[c]));
  return rgb.map((value) => value / luminance(rgb));
}

// Linear rgb [3] of a light.
function rgbOf({ rgb, kelvin, stops }) {
  const tint = blackbody(kelvin);
  return rgb.map((value, c) => value * tint[c] * 2 ** stops);
}

// A colour as a screen shows it, as bright as it can be.
function hexOf(rgb) {
  return "#" + rgb.map((value) => Math.round(255 * encoded(value / Math.max(...rgb, 1e-9))).toString(16).padStart(2, "0")).join("");
}

// Directions of a light with their shares: the cells of a square that faces the head; together they give 1 to it.
function samplesOf({ azimuth, elevation, size }) {
  const middle = directionOf(azimuth, elevation);
  if (!size) return [[middle, 1]];
  const [wide, side] = [2 * Math.tan((size / 2) * DEGREE), limited(Math.ceil(size / APART_DEG), 2, MOST_A_SIDE)];
  const across = ofLength1(cross(Math.abs(middle[1]) < 0.99 ? [0, 1, 0] : [0, 0, 1], middle));
  const along = cross(middle, across);
  const cell = (i) => wide * ((i + 0.5) / side - 0.5);
  const directions = Array.from({ length: side * side }, (_, i) => {
    const [u, v] = [cell(i % side), cell(Math.floor(i / side))];
    return ofLength1(middle.map((value, c) => value + u * across[c] + v * along[c]));
  });
  const total = directions.reduce((sum, direction) => sum + dot(direction, middle), 0);
  return directions.map((direction) => [direction, 1 / total]);
}

// The lights of a --light text: a direction, a word or a preset, each with or without a name, with keys; or keys alone.
function lightsOf(text, known) {
  const wrong = (what) => new Error(`light ${text}: ${what}`);
  const [given, places] = [{}, []]; // values of keys; a name, if any, and the direction or preset
  for (const part of text.split(";").filter((one) => one.trim())) {
    const [first, second, more] = part.split("=").map((one) => one.trim());
    if (more !== undefined) throw wrong("give ; between keys, as in from=60,10;stops=1");
    if (second === undefined) places.push(["", first]);
    else if (OTHER_KEYS.includes(first)) throw wrong(`${first}= is not shown in a page; leave it out`);
    else if (first === "name" || KEYS[first]) given[first] = second;
    else places.push([first, second]);
  }
  const numbers = (key, otherwise) => {
    if (given[key] === undefined) return otherwise;
    const [count, low, high] = KEYS[key];
    const values = numbersIn(given[key]);
    if (values.length === count && values.every((value) => value >= low && value <= high)) return values;
    throw wrong(`${key} ${given[key]}: give ${count === 1 ? "a number" : `${count} numbers`} from ${low} to ${high}`);
  };
  const byKeys = [given.from, given.at].filter((one) => one !== undefined).length;
  if (byKeys) places.push(["", given.from]);
  if (!places.length || byKeys + (places.length > 1) > 1) throw wrong("give one direction or preset");
  if (places.length > 1 && Object.keys(given).length) throw wrong("keys are of one light; give light= once more");
  const [tint, [stops]] = [numbers("rgb", [1, 1, 1]), numbers("stops", [0])];
  return places.flatMap(([prefix, where]) => {
    const name = given.name ?? prefix;
    if (name && !isName(name)) throw wrong(`${name} is no name of a light; give letters and digits`);
    const lights = given.at ? [placed(numbers("at"), numbers("size", [0])[0])] : placesOf(where, known);
    if (!lights) throw wrong(`${where} is no direction; give AZ,EL, ${Object.keys(known.words).join(", ")}, or a preset: ${Object.keys(known.presets).join(", ")}`);
    return lights.map((light) => newLight({
      ...light,
      name: [name, light.name].filter(Boolean).join("_") || (light.original ? ORIGINAL : ""),
      rgb: (light.rgb ?? [1, 1, 1]).map((value, c) => value * tint[c]),
      stops: (light.stops ?? 0) + stops,
      kelvin: numbers("kelvin", [light.kelvin ?? WHITE_K])[0],
      size: numbers("size_deg", [light.size ?? 0])[0],
    }));
  });
}

// Lights of AZ,EL[,STRENGTH], a word, or a preset; null of anything else.
function placesOf(where, { words, presets }) {
  if (Object.hasOwn(words, where)) return [ofPacked(words[where])];
  if (Object.hasOwn(presets, where)) return presets[where].map(ofPacked);
  const values = numbersIn(where);
  const [azimuth, elevation, strength = 1] = values;
  const isOne = [2, 3].includes(values.length) && values.every(Number.isFinite);
  if (!isOne || Math.abs(elevation) > 90 || strength < 0) return null;
  return [{ ...towards(azimuth, elevation), rgb: [strength, strength, strength] }];
}

// A near light as a far one: from the same side, as wide as it is seen from the head.
function placed(at, side) {
  return { ...azelOf(at), size: (2 * Math.atan2(side / 2, Math.hypot(...at))) / DEGREE, near: true };
}

// A light of a word or a preset, from the fields that it has in facerf.
function ofPacked({ name, azel_deg, at_m, size_m, size_deg, rgb, kelvin, stops, original }) {
  const far = azel_deg ? { ...towards(...azel_deg), size: size_deg } : { original, uniform: !original };
  const place = at_m ? placed(at_m, size_m) : far;
  return { name, rgb, kelvin: kelvin ?? WHITE_K, stops, ...place };
}

// The --light texts of lights. They have names where one has, or where they need keys and are several, or are `named`.
function textsOf(lights, named) {
  const parts = lights.map(partsOf);
  const areShort = parts.every(({ short }) => short);
  if (named || lights.some(({ name }) => name) || (lights.length > 1 && !areShort)) {
    return namesOf(lights).map((name, i) => {
      const { short, keys } = parts[i];
      if (lights[i].original && name === ORIGINAL) return keys.replace("from=", "");
      return short ? `${name}=${short}` : `name=${name};${keys}`;
    });
  }
  return lights.length ? [areShort ? parts.map(({ short }) => short).join(";") : parts[0].keys] : [];
}

// A light by its keys, and by its direction alone where that tells all.
function partsOf({ azimuth, elevation, uniform, original, rgb, kelvin, stops, size }) {
  const where = original ? ORIGINAL : uniform ? "uniform" : `${rounded(azimuth, 2)},${rounded(elevation, 2)}`;
  const colour = rgb.every((value) => value === 1) ? "" : rgb.map((value) => Number(value.toPrecision(4))).join(",");
  const keys = { kelvin: kelvin !== WHITE_K && kelvin, stops: rounded(stops, 2), size_deg: !uniform && !original && rounded(size, 2) };
  const others = Object.keys(keys).filter((key) => keys[key]).map((key) => `${key}=${keys[key]}`);
  const short = others.length || colour || uniform || original ? "" : where;
  return { short, keys: [`from=${where}`, colour && `rgb=${colour}`, ...others].filter(Boolean).join(";") };
}

// Names that differ: the lights' own, or of their numbers.
function namesOf(lights) {
  const taken = new Set();
  return lights.map(({ name }, i) => {
    let free = name || `light${i + 1}`;
    for (let n = 2; taken.has(free); n++) free = `${name || "light"}_${n}`;
    taken.add(free);
    return free;
  });
}
