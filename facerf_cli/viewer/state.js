// What the page shows: lights, map, exposure. Read from and written to the address, and to a command line.

const MOST_LIGHTS = 9;

function newLight(azimuth, elevation, colour = "#ffffff", stops = 0) {
  return { azimuth, elevation, colour, stops };
}

function initialState() {
  return {
    lights: [newLight(40, 25)],
    selected: 0,
    map: null,
    rotate: 0,
    mapStops: 0,
    exposure: null, // EV; null: automatic
    background: true,
    compare: null, // percent of the frame that shows the photo
    panel: true,
  };
}

// Linear rgb [3] of a light: its colour, as shown on a screen, times its intensity.
function rgbOf(light) {
  if (light.rgb) return light.rgb.map((value) => value * 2 ** light.stops);
  const channels = [1, 3, 5].map((i) => decoded(parseInt(light.colour.slice(i, i + 2), 16) / 255));
  return channels.map((value) => value * 2 ** light.stops);
}

// The lights of "az,el[,r,g,b][;...]", as --light takes them; null where it is none.
function lightsOf(text) {
  const lights = [];
  for (const part of text.split(";").slice(0, MOST_LIGHTS)) {
    const values = part.split(",").map(Number);
    if (![2, 5].includes(values.length) || values.some((value) => !Number.isFinite(value))) return null;
    const light = newLight(turned(values[0]), limited(values[1], -90, 90));
    if (values.length === 5) {
      light.rgb = values.slice(2).map((value) => Math.max(0, value));
      const most = Math.max(...light.rgb, 1e-6);
      light.colour = hexOf(light.rgb.map((value) => value / most));
    }
    lights.push(light);
  }
  return lights;
}

function hexOf(rgb) {
  return "#" + rgb.map((value) => Math.round(255 * encoded(value)).toString(16).padStart(2, "0")).join("");
}

function turned(degrees) {
  return ((((degrees + 180) % 360) + 360) % 360) - 180;
}

function limited(value, low, high) {
  return Math.min(high, Math.max(low, value));
}

// Read the address: #light=75,20;-120,10&env=studio&rotate=30&ev=-0.5&background=none&compare=50&panel=0
function readAddress(state, hash, maps) {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  const number = (name, low, high) => {
    const value = given.has(name) ? Number(given.get(name)) : NaN;
    return Number.isFinite(value) ? limited(value, low, high) : null;
  };
  const map = maps.find((one) => one.name === given.get("env")) || null;
  const lights = given.has("light") ? lightsOf(given.get("light")) : null;
  if (lights) state.lights = lights;
  else if (map) state.lights = [];
  state.map = map;
  state.selected = 0;
  state.rotate = turned(number("rotate", -3600, 3600) ?? 0);
  state.mapStops = number("mapstops", -6, 6) ?? 0;
  state.exposure = number("ev", -20, 20);
  state.background = given.get("background") !== "none";
  state.compare = number("compare", 0, 100);
  state.panel = given.get("panel") !== "0";
  return state;
}

function addressOf(state) {
  const parts = [];
  if (state.lights.length) parts.push("light=" + state.lights.map(lightText).join(";"));
  if (state.map && state.map.command) {
    parts.push("env=" + state.map.name);
    if (state.rotate) parts.push("rotate=" + state.rotate);
    if (state.mapStops) parts.push("mapstops=" + state.mapStops);
  }
  if (state.exposure !== null) parts.push("ev=" + state.exposure);
  if (!state.background) parts.push("background=none");
  if (state.compare !== null) parts.push("compare=" + state.compare);
  if (!state.panel) parts.push("panel=0");
  return "#" + parts.join("&");
}

function lightText(light) {
  const rgb = rgbOf(light);
  const where = `${Math.round(10 * light.azimuth) / 10},${Math.round(10 * light.elevation) / 10}`;
  return rgb.every((value) => value === 1) ? where : where + "," + rgb.map((value) => Number(value.toPrecision(4))).join(",");
}

// The command lines that make the same image.
function commandOf(state, photo, ev) {
  if (!state.map && !state.lights.length) return "# add a light, or choose an environment";
  const lines = [];
  const both = Boolean(state.map) && state.lights.length > 0;
  let line = `facerf relight ${photo}`;
  if (state.map) {
    if (state.map.command) lines.push(state.map.command);
    line += ` --envmap ${quoted(state.map.path)}`;
    if (state.rotate) line += ` --rotate ${state.rotate}`;
  }
  if (state.lights.length) line += ` --light '${state.lights.map(lightText).join(";")}'`;
  const mapStops = state.map && !both ? state.mapStops : 0; // one map alone: its intensity is exposure
  line += ` --exposure ${Number((ev + mapStops).toFixed(2))}`;
  if (!state.background) line += " --background none";
  lines.push(line + " -o out");
  if (both) {
    const scale = state.mapStops ? `, that of the map times ${Number((2 ** state.mapStops).toPrecision(3))}` : "";
    lines.push(`# the map and the lights are two images: add their EXRs${scale}`);
  }
  return lines.join("\n");
}

function quoted(text) {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : "'" + text.replaceAll("'", `'"'"'`) + "'";
}
