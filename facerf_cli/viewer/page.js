// The page: controls change the state; every change is shown in the next frame, in the address and as a command.

const MOST_LIGHTS = 9;
// Of new lights: azimuth and elevation.
const PLACES = [[-60, 10], [40, 25], [145, 25], [-145, 25], [0, 80], [75, -10], [-90, 40], [0, -50], [180, 15]];

const newLight = (azimuth, elevation, colour = "#ffffff", stops = 0) => ({ azimuth, elevation, colour, stops });
const byteText = (value) => Math.round(255 * encoded(value)).toString(16).padStart(2, "0");
const rounded = (value, digits) => Number(value.toFixed(digits));
const inDegrees = (value) => `${Math.round(value)}°`;
const signed = (value, digits, unit) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)} ${unit}`;
const inStops = (value) => signed(value, 1, "stops");
// What the controls change: of the light that is chosen, of all lights, of the map and of the image; in words.
const LIGHT = { azimuth: inDegrees, elevation: inDegrees, stops: inStops, colour: (text) => text };
const ROOM = { room: (share) => `${Math.round(100 * share)} %` };
const MAP = { rotate: inDegrees, mapStops: inStops };
const IMAGE = { exposure: (value) => signed(value, 2, "EV") };

// Linear rgb [3] of a light: its colour, as shown on a screen, times its intensity.
function rgbOf(light) {
  const rgb = light.rgb ?? [1, 3, 5].map((i) => decoded(parseInt(light.colour.slice(i, i + 2), 16) / 255));
  return rgb.map((value) => value * 2 ** light.stops);
}

// The lights of "az,el[,r,g,b][;...]", as --light takes them; null where it is none.
function lightsOf(text) {
  const all = (text ?? "").split(";").slice(0, MOST_LIGHTS).map((part) => part.split(",").map(Number));
  if (all.some((values) => ![2, 5].includes(values.length) || !values.every(Number.isFinite))) return null;
  return all.map(([azimuth, elevation, ...given]) => {
    const light = newLight(turned(azimuth), limited(elevation, -90, 90));
    if (!given.length) return light;
    const rgb = given.map((value) => Math.max(0, value));
    const hex = rgb.map((value) => byteText(value / Math.max(...rgb, 1e-6)));
    return { ...light, rgb, colour: "#" + hex.join("") };
  });
}

function lightText(light) {
  const rgb = rgbOf(light).map((value) => Number(value.toPrecision(4)));
  const where = [rounded(light.azimuth, 1), rounded(light.elevation, 1)];
  return (rgb.every((value) => value === 1) ? where : [...where, ...rgb]).join(",");
}

// Read ?light=... or #light=75,20;-120,10&room=0.1&env=studio&rotate=30&mapstops=-1&ev=-0.5&background=none&compare=50
function stateOf(address, maps) {
  const given = new URLSearchParams(address.hash.length > 1 ? address.hash.slice(1) : address.search);
  const number = (name, low, high) => {
    const value = Number.parseFloat(given.get(name));
    return Number.isFinite(value) ? limited(value, low, high) : null;
  };
  const map = maps.find((one) => one.name === given.get("env")) ?? null;
  return {
    lights: lightsOf(given.get("light")) ?? (map ? [] : [newLight(40, 25)]),
    selected: 0,
    room: number("room", 0, 1), // what it sends back; null: by the background
    map,
    rotate: turned(number("rotate", -3600, 3600) ?? 0),
    mapStops: number("mapstops", -6, 6) ?? 0,
    exposure: number("ev", -20, 20), // null: automatic
    background: given.get("background") !== "none",
    compare: number("compare", 0, 100), // percent of the frame that shows the photo; null: none
  };
}

function addressOf({ lights, room, map, rotate, mapStops, exposure, background, compare }) {
  const parts = lights.length ? ["light=" + lights.map(lightText).join(";")] : [];
  if (room !== null) parts.push("room=" + room);
  if (map?.command) {
    parts.push("env=" + map.name);
    if (rotate) parts.push("rotate=" + rotate);
    if (mapStops) parts.push("mapstops=" + mapStops);
  }
  if (exposure !== null) parts.push("ev=" + exposure);
  if (!background) parts.push("background=none");
  if (compare !== null) parts.push("compare=" + compare);
  return "#" + parts.join("&");
}

// The share of the lights that comes from all around, too, as `facerf relight` has it.
function roomOf({ room, background }, data) {
  if (!data.room) return 0;
  return room ?? (background && data.background ? data.room.bright : data.room.dark);
}

// The command lines that make the same image; a map shines together with lights where all have names.
function commandOf({ map, lights, room, rotate, mapStops, background }, data, ev) {
  if (!map && !lights.length) return "# add a light, or choose an environment";
  const quoted = (text) => (/^[\w@%+=:,./-]+$/.test(text) ? text : "'" + text.replaceAll("'", `'"'"'`) + "'");
  const both = Boolean(map) && lights.length > 0;
  const texts = lights.map((light, i) => (both ? `light${i + 1}=` : "") + lightText(light));
  let line = `facerf relight ${data.source}`;
  const keys = [`map=${map?.path}`, rotate && `rotate=${rotate}`, mapStops && `stops=${mapStops}`];
  if (both) line += ` --light ${quoted(["name=map", ...keys.filter(Boolean)].join(";"))}`;
  else if (map) line += ` --envmap ${quoted(map.path)}` + (rotate ? ` --rotate ${rotate}` : "");
  if (lights.length) line += ` --light '${texts.join(";")}'`;
  if (lights.length && data.room && room !== null) line += ` --room ${room || "none"}`;
  line += ` --exposure ${rounded(ev + (map && !both ? mapStops : 0), 2)}`; // stops of a map alone are exposure
  if (data.background && !background) line += " --background none";
  return (map?.command ? map.command + "\n" : "") + line + " -o out";
}

class Page {
  constructor(data, images, ratios) {
    this.data = data;
    this.rig = new Rig(data);
    this.maps = data.envmaps.map((map) => new LatLong({ ...map, pixels: floatsOf(map.pixels) }));
    this.view = this.newView(images);
    ratios.forEach((image, light) => this.view.add(light, pixelsOf(image, ...data.small)));
    byId("before").src = images.photo.src;
    byId("frame").style.setProperty("--sides", data.size[0] / data.size[1]);
    byId("background").hidden = !data.background;
    byId("room").parentElement.hidden = !data.room;
    this.state = stateOf(location, this.maps);
    this.connect();
    this.fillMaps();
    this.frame();
  }

  newView(images) {
    const view = GpuView.create(byId("view"), this.data, images);
    if (view) return view;
    this.say("This browser has no WebGL2: the image is smaller and slower.");
    byId("view").replaceWith(byId("view").cloneNode());
    return new CanvasView(byId("view"), this.data, images);
  }

  get light() {
    return this.state.lights[this.state.selected];
  }

  say(text) {
    byId("message").textContent = text;
  }

  change(values) {
    Object.assign(this.state, values);
    this.waiting ??= requestAnimationFrame(() => this.frame());
  }

  changeLight(values) {
    if (this.light) Object.assign(this.light, values);
    this.change({});
  }

  // Weights [images * 3] of all that shines; the last image is that of a room, whose directions send 4 times as much.
  weights() {
    const { lights, map, rotate, mapStops } = this.state;
    const key = map && `${this.maps.indexOf(map)} ${rotate}`;
    if (map && key !== this.mapKey) [this.mapKey, this.mapWeights] = [key, this.rig.mapWeights(map, rotate)];
    const weights = new Float64Array(3 * this.data.scales.length);
    if (map) this.mapWeights.forEach((value, i) => (weights[i] = value * 2 ** mapStops));
    const [room, last] = [4 * roomOf(this.state, this.data), weights.length - 3];
    for (const light of lights) {
      const [rgb, around] = [rgbOf(light), this.rig.around(directionOf(light.azimuth, light.elevation))];
      for (const [i, share] of around) rgb.forEach((value, c) => (weights[3 * i + c] += share * value));
      rgb.forEach((value, c) => (weights[last + c] += room * value));
    }
    return weights;
  }

  frame() {
    this.waiting = null;
    const { state, data } = this;
    const weights = this.weights();
    this.ev = state.exposure ?? automaticEv(data.exposure, weights);
    const exposed = scaled(weights, data.scales).map((value) => value * 2 ** this.ev);
    this.view.draw(exposed, state.background && data.background);
    this.update();
    document.body.dataset.settled = "true";
    clearTimeout(this.later);
    this.later = setTimeout(() => history.replaceState(null, "", addressOf(state)), 300); // to be sent to others
  }

  // Show the state in the controls.
  update() {
    const { state, light, data } = this;
    this.show(LIGHT, light ?? newLight(0, 0), !light);
    this.show(ROOM, { room: roomOf(state, data) }, !light);
    this.show(MAP, state, !state.map);
    this.show(IMAGE, { exposure: this.ev }, false);
    byId("envmap").value = this.maps.indexOf(state.map);
    byId("remove").disabled = !light;
    byId("add").disabled = state.lights.length >= MOST_LIGHTS;
    const pressed = { auto: state.exposure === null, background: state.background, compare: state.compare !== null };
    for (const [id, is] of Object.entries(pressed)) byId(id).setAttribute("aria-pressed", String(is));
    byId("chips").replaceChildren(...state.lights.map((one, i) => this.chip(one, i)));
    byId("command").textContent = commandOf(state, data, this.ev);
    for (const id of ["before", "split"]) byId(id).hidden = state.compare === null;
    byId("before").style.clipPath = `inset(0 ${100 - state.compare}% 0 0)`;
    byId("split").value = state.compare;
  }

  // Show values in their controls, which work unless they are `idle`.
  show(controls, values, idle) {
    for (const [id, inWords] of Object.entries(controls)) {
      Object.assign(byId(id), { value: values[id], disabled: idle });
      const text = idle ? "–" : inWords(values[id]);
      byId(id).setAttribute("aria-valuetext", text);
      document.querySelector(`output[for="${id}"]`).textContent = text;
    }
  }

  chip(light, i) {
    const chip = Object.assign(document.createElement("button"), { type: "button", textContent: i + 1 });
    chip.style.setProperty("--light", light.colour);
    chip.ariaLabel = `Light ${i + 1}: azimuth ${Math.round(light.azimuth)}, elevation ${Math.round(light.elevation)}`;
    chip.ariaPressed = String(i === this.state.selected);
    chip.onclick = () => this.change({ selected: i });
    return chip;
  }

  fillMaps() {
    byId("envmap").replaceChildren(new Option("None", -1), ...this.maps.map((map, i) => new Option(map.name, i)));
  }

  connect() {
    const on = (id, apply) => byId(id).addEventListener("input", (event) => apply(event.target.value));
    for (const id of Object.keys({ ...ROOM, ...MAP, ...IMAGE })) on(id, (value) => this.change({ [id]: Number(value) }));
    for (const id of ["azimuth", "elevation", "stops"]) on(id, (value) => this.changeLight({ [id]: Number(value) }));
    on("colour", (colour) => this.changeLight({ colour, rgb: undefined }));
    on("split", (percent) => this.change({ compare: Number(percent) }));
    on("envmap", (i) => this.change({ map: this.maps[i] ?? null }));
    const actions = {
      add: () => this.add(),
      remove: () => this.remove(),
      auto: () => this.change({ exposure: this.state.exposure === null ? this.ev : null }),
      background: () => this.change({ background: !this.state.background }),
      compare: () => this.change({ compare: this.state.compare === null ? 50 : null }),
      copy: () => this.copy(),
      save: () => this.save(),
      open: () => byId("file").click(),
    };
    for (const [id, act] of Object.entries(actions)) byId(id).addEventListener("click", act);
    byId("file").addEventListener("change", (event) => this.open(event.target.files[0]));
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => (event.preventDefault(), this.open(event.dataTransfer.files[0])));
    addEventListener("hashchange", () => this.change(stateOf(location, this.maps)));
    addEventListener("keydown", (event) => this.key(event));
    const view = byId("view");
    view.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      view.setPointerCapture(event.pointerId);
      if (!this.light) this.add();
      this.drag(event);
    });
    view.addEventListener("pointermove", (event) => view.hasPointerCapture(event.pointerId) && this.drag(event));
  }

  // The light comes from where one points: as far from the head's middle as on a ball around it.
  drag(event) {
    const box = byId("view").getBoundingClientRect();
    const [headX, headY, headRadius] = this.data.head;
    const radius = headRadius * Math.min(box.width, box.height);
    const x = (event.clientX - box.left - box.width * headX) / radius;
    const y = (box.top + box.height * headY - event.clientY) / radius;
    const ring = Math.hypot(x, y) || 1;
    const angle = Math.min(ring, 1.95) * 90 * DEGREE;
    const [aside, up] = [(Math.sin(angle) * x) / ring, (Math.sin(angle) * y) / ring];
    const azimuth = Math.round(Math.atan2(aside, Math.cos(angle)) / DEGREE);
    this.changeLight({ azimuth, elevation: Math.round(Math.asin(up) / DEGREE) });
  }

  // Arrows move the light, but where they move a control.
  key(event) {
    if (event.target.closest("select, input, button") || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 1 : 5;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (!moves[event.key] || !this.light) return;
    event.preventDefault();
    const [aside, up] = moves[event.key];
    const { azimuth, elevation } = this.light;
    this.changeLight({ azimuth: turned(azimuth + aside), elevation: limited(elevation + up, -90, 90) });
  }

  // Add a light where no other one is.
  add() {
    const { lights } = this.state;
    const isFree = ([x, y]) => lights.every((light) => Math.hypot(light.azimuth - x, light.elevation - y) > 10);
    lights.push(newLight(...(PLACES.find(isFree) ?? PLACES[0])));
    this.change({ selected: lights.length - 1 });
  }

  remove() {
    this.state.lights.splice(this.state.selected, 1);
    this.change({ selected: Math.max(0, this.state.selected - 1) });
  }

  async open(file) {
    if (!file) return;
    try {
      this.maps.push(await readMap(file));
      this.fillMaps();
      this.say(`${file.name} is the environment now`);
      this.change({ map: this.maps.at(-1) });
    } catch (error) {
      const isCut = error instanceof RangeError; // of a DataView
      this.say(`${file.name}: ${isCut ? "the map is cut short; copy it again" : error.message}`);
    }
  }

  async copy() {
    getSelection().selectAllChildren(byId("command"));
    const done = navigator.clipboard?.writeText(byId("command").textContent) ?? Promise.reject();
    const say = (text) => () => this.say(text);
    await done.then(say("The command is copied"), say("Press Ctrl+C to copy the selected command"));
  }

  save() {
    byId("view").toBlob((blob) => {
      const link = document.createElement("a");
      Object.assign(link, { href: URL.createObjectURL(blob), download: `${this.data.title}_relit.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
      this.say(`${link.download} is saved`);
    });
  }
}

async function start() {
  const data = JSON.parse(byId("data").textContent);
  const images = { photo: await imageOf(data.photo, "jpeg") };
  for (const name of ["guide", "plate", "matte"]) images[name] = await imageOf(data[name], "webp");
  data.exposure.person = await brightestOf(data.exposure.person);
  if (data.exposure.face) data.exposure.face = floatsOf(data.exposure.face);
  const ratios = await Promise.all(data.ratios.map((ratio) => imageOf(ratio, "jpeg")));
  byId("message").textContent = "";
  new Page(data, images, ratios);
}

start().catch((error) => (byId("message").textContent = `The page cannot be shown: ${error.message}`));
