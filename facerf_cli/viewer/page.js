// The page: controls change the state; every change is shown in the next frame, in the address and as a command.

// Of new lights: azimuth and elevation.
const PLACES = [[-60, 10], [40, 25], [145, 25], [-145, 25], [0, 80], [75, -10], [-90, 40], [0, -50], [180, 15]];
// Controls, in their sections: label, unit, least, most and step of the slider, and what may be typed, if more.
const CONTROLS = {
  light: {
    azimuth: ["Azimuth", "°", -180, 180, 1],
    elevation: ["Elevation", "°", -90, 90, 1],
    stops: ["Intensity", "stops", -6, 6, 0.1, -20, 20],
    kelvin: ["Colour", "K", 1700, 12000, 50, 1667, 25000],
    size: ["Softness", "°", 0, 120, 1],
  },
  original: { originalStops: ["Original light", "stops", -6, 6, 0.1, -20, 20] },
  ambient: { ambient: ["Ambient", "%", 0, 30, 1, 0, 100] },
  map: { rotate: ["Rotate", "°", -180, 180, 1], mapStops: ["Intensity", "stops", -6, 6, 0.1] },
  image: { exposure: ["Exposure", "EV", -6, 8, 0.05, -20, 20] },
};
const SHOWN = { ambient: 100 }; // a value in the state, times this, is that of its control
const MARK_MARGIN = 14; // pixels that a mark keeps from the edge of the picture
const BEHIND = 1.98; // how far from the head's middle a light can be dragged, where 1 is its outline and 2 behind it

// Read #light=key=40,20;stops=-1&light=rim&ambient=0.1&env=studio&rotate=30&mapstops=-1&ev=-0.5&background=none&compare=50
function stateOf(address, maps, data) {
  const given = new URLSearchParams(address.hash.length > 1 ? address.hash.slice(1) : address.search);
  const number = (name, low, high) => {
    const value = Number.parseFloat(given.get(name));
    return Number.isFinite(value) ? limited(value, low, high) : null;
  };
  const named = (name) => maps.find((map) => map.name === given.get(name));
  const map = named("env") ?? named("ambient") ?? null; // a map may be the ambient light
  const found = { lights: map ? [] : [newLight({ azimuth: 40, elevation: 25 })], original: [], message: "" };
  try {
    if (given.has("light")) {
      const lights = given.getAll("light").flatMap((text) => lightsOf(text, data));
      found.original = lights.filter(({ original }) => original);
      found.lights = lights.filter(({ original }) => !original);
    }
    if (found.original.length > 1) found.message = "The original light occurs twice; the first is shown";
    else if (found.lights.length > MOST_LIGHTS) found.message = `The first ${MOST_LIGHTS} of ${found.lights.length} lights are shown`;
    else if (found.lights.some(({ near }) => near)) found.message = NEAR;
  } catch (error) {
    found.message = error.message;
  }
  if (!map && given.has("env")) found.message = `env=${given.get("env")}: give ${maps.map(({ name }) => name).join(", ")}`;
  return {
    lights: found.lights.slice(0, MOST_LIGHTS),
    original: found.original[0] ?? null, // the photo's original light
    message: found.message,
    selected: 0,
    ambient: named("ambient") || given.get("ambient") === "none" ? 0 : number("ambient", 0, 1), // null: by the background
    map,
    rotate: turned(number("rotate", -3600, 3600) ?? 0),
    mapStops: number("mapstops", -6, 6) ?? 0,
    exposure: number("ev", -20, 20), // null: automatic
    background: given.get("background") !== "none",
    compare: number("compare", 0, 100), // percent of the frame that shows the photo; null: none
  };
}

const NEAR = "A near light is shown as a far one from its side; the command names what is shown";

// All lights, including the original light.
const allOf = ({ lights, original }) => (original ? [...lights, original] : lights);

function addressOf(state) {
  const { ambient, map, rotate, mapStops, exposure, background, compare } = state;
  const parts = textsOf(allOf(state)).map((text) => "light=" + text);
  if (ambient !== null) parts.push("ambient=" + rounded(ambient, 4));
  if (map?.command) {
    parts.push("env=" + map.name);
    if (rotate) parts.push("rotate=" + rotate);
    if (mapStops) parts.push("mapstops=" + mapStops);
  }
  if (exposure !== null) parts.push("ev=" + rounded(exposure, 2));
  if (!background) parts.push("background=none");
  if (compare !== null) parts.push("compare=" + compare);
  return "#" + parts.join("&");
}

// Ambient fill as a fraction of the lights, as in `facerf relight`; of a map on its own only if it is set.
function ambientOf({ ambient, background, lights, map, original }, data) {
  if (!data.ambient || hasAmbient(lights) || !(lights.length || map)) return 0;
  return ambient ?? (original || !lights.length ? 0 : background && data.background ? data.ambient.bright : data.ambient.dark);
}

// True if a light replaces the ambient fill.
const hasAmbient = (lights) => lights.some(({ uniform, name }) => uniform || name === AMBIENT);

// The command lines that make the same image; a map shines together with lights where all have names.
function commandOf(state, data, ev, ofAmbient) {
  const { map, lights, original, ambient, rotate, mapStops, background } = state;
  if (!map && !lights.length && !original) return "# add a light, or choose an environment";
  const quoted = (text) => (/^[\w@%+=:,./-]+$/.test(text) ? text : "'" + text.replaceAll("'", `'"'"'`) + "'");
  const ambientOfMap = !lights.length && ofAmbient.some(Boolean);
  const both = Boolean(map && (lights.length || original || ambientOfMap));
  const keys = [`map=${map?.path}`, rotate && `rotate=${rotate}`, mapStops && `stops=${mapStops}`];
  const asLight = both && mapStops; // which --envmap has none of
  const texts = asLight ? [["name=envmap", ...keys.filter(Boolean)].join(";")] : [];
  texts.push(...textsOf(allOf(state), both));
  if (ambientOfMap) texts.push(`name=${AMBIENT};${partsOf(newLight({ uniform: true, rgb: ofAmbient })).keys}`);
  let line = `facerf relight ${data.source}`;
  if (map && !asLight) line += ` --envmap ${quoted((both ? "envmap=" : "") + map.path)}` + (rotate ? ` --rotate ${rotate}` : "");
  line += texts.map((text) => ` --light ${quoted(text)}`).join("");
  if (lights.length && data.ambient && ambient !== null && !hasAmbient(lights) && (ambient || !original)) line += ` --ambient ${rounded(ambient, 4) || "none"}`;
  const exposure = rounded(ev + (map && !both ? mapStops : 0), 2); // stops of a map alone are exposure
  if (exposure || !original) line += ` --exposure ${exposure}`;
  if (data.background && !background) line += " --background none";
  return (map?.command ? map.command + "\n" : "") + line + " -o out";
}

// Where a light stands on a flat picture of all directions, in radii of the head: 1 is its outline, 2 behind it.
function flatOf({ azimuth, elevation }) {
  const [x, y, z] = directionOf(azimuth, elevation);
  const ring = Math.acos(limited(z, -1, 1)) / DEGREE / 90;
  const side = Math.hypot(x, y);
  return side < 1e-6 ? [ring, 0] : [(x / side) * ring, (y / side) * ring];
}

// The light at a place of that picture.
function azelAt(x, y) {
  const ring = Math.hypot(x, y) || 1e-9;
  const angle = Math.min(ring, BEHIND) * 90 * DEGREE;
  const { azimuth, elevation } = azelOf([(Math.sin(angle) * x) / ring, (Math.sin(angle) * y) / ring, Math.cos(angle)]);
  return { azimuth: Math.round(azimuth), elevation: Math.round(elevation) };
}

// As many children of an element as there are lights: what has the focus or the pointer is kept.
function fill(element, count, make) {
  while (element.children.length > count) element.lastChild.remove();
  while (element.children.length < count) element.append(make(element.children.length));
  return [...element.children];
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
    byId("uniformRow").hidden = byId("ambientRows").hidden = !data.ambient;
    for (const [section, controls] of Object.entries(CONTROLS)) {
      byId(`${section}Rows`).append(...Object.entries(controls).map(([id, control]) => this.row(id, control)));
    }
    byId("originalRows").hidden = !data.words.original;
    byId("originalRows").querySelector("label").htmlFor = "original";
    byId("presets").append(...Object.keys(data.presets).map((name) => new Option(name)));
    this.fillMaps();
    this.connect();
    this.load(location);
    this.frame();
  }

  newView(images) {
    const view = GpuView.create(byId("view"), this.data, images);
    if (view) return view;
    this.say("This browser has no WebGL2: the image is smaller and slower.");
    byId("view").replaceWith(byId("view").cloneNode());
    return new CanvasView(byId("view"), this.data, images);
  }

  // A slider and a number for a value; a double click sets it back.
  row(id, [label, unit, min, max, step, least = min, most = max]) {
    const row = Object.assign(document.createElement("div"), { className: "control" });
    const title = Object.assign(document.createElement("label"), { textContent: label, htmlFor: id });
    const slider = Object.assign(document.createElement("input"), { type: "range", id, min, max, step });
    const typed = Object.assign(document.createElement("input"), { type: "number", id: `${id}Typed`, min: least, max: most, step: "any" });
    const change = (text) => {
      const value = Number.parseFloat(text);
      if (Number.isFinite(value)) this.set(id, limited(value, least, most) / (SHOWN[id] ?? 1));
    };
    slider.oninput = () => change(slider.value);
    typed.oninput = () => change(typed.value);
    typed.onblur = () => this.change({});
    row.ondblclick = (event) => event.target !== typed && this.set(id, null);
    slider.ariaLabel = typed.ariaLabel = `${label}, ${unit}`;
    row.append(title, slider, typed, Object.assign(document.createElement("span"), { textContent: unit }));
    return row;
  }

  // Set a value of the light or the image; null is what it begins with.
  set(id, value) {
    const { original } = this.state;
    if (id in CONTROLS.light) this.changeLight({ [id]: value ?? newLight()[id] });
    else if (id in CONTROLS.original) this.change({ original: original && { ...original, stops: value ?? 0 } });
    else this.change({ [id]: value ?? (id in CONTROLS.map ? 0 : null) });
  }

  get light() {
    return this.state.lights[this.state.selected];
  }

  say(text) {
    byId("message").textContent = text;
  }

  // Show the state of an address.
  load(address) {
    const { message, ...state } = stateOf(address, this.maps, this.data);
    if (message || this.state) this.say(message);
    this.state ??= state;
    this.change(state);
  }

  change(values) {
    Object.assign(this.state, values);
    this.waiting ??= requestAnimationFrame(() => this.frame());
  }

  changeLight(values) {
    if (this.light) Object.assign(this.light, values);
    this.change({});
  }

  // Weights [images * 3] of all that shines; the last image is under ambient fill, 4 times as strong.
  weights() {
    const { lights, map, rotate, mapStops } = this.state;
    const key = map && `${this.maps.indexOf(map)} ${rotate}`;
    if (map && key !== this.mapKey) [this.mapKey, this.mapWeights] = [key, this.rig.mapWeights(map, rotate)];
    const weights = new Float64Array(3 * this.data.scales.length);
    if (map) this.mapWeights.forEach((value, i) => (weights[i] = value * 2 ** mapStops));
    const sent = [0, 1, 2].map((c) => lights.length ? 0 : groups(weights, 3).reduce((sum, rgb) => sum + rgb[c] / 4, 0));
    const last = weights.length - 3;
    for (const light of lights) {
      const rgb = rgbOf(light);
      rgb.forEach((value, c) => (sent[c] += value));
      if (light.uniform) rgb.forEach((value, c) => (weights[last + c] += 4 * value));
      else {
        for (const [i, share] of this.rig.sharesOf(samplesOf(light))) rgb.forEach((value, c) => (weights[3 * i + c] += share * value));
      }
    }
    this.ofAmbient = sent.map((value) => value * ambientOf(this.state, this.data));
    this.ofAmbient.forEach((value, c) => (weights[last + c] += 4 * value));
    return weights;
  }

  frame() {
    this.waiting = null;
    const { state, data } = this;
    const weights = this.weights();
    this.ev = state.exposure ?? (state.original ? 0 : automaticEv(data.exposure, weights));
    const exposed = weights.map((value) => value * 2 ** this.ev);
    const original = state.original ? rgbOf(state.original).map((value) => value * 2 ** this.ev) : [0, 0, 0];
    this.view.draw(scaled(exposed, data.scales), original, state.background && data.background);
    drawBall(byId("ballView"), this.rig.lights, exposed);
    this.update();
    document.body.dataset.settled = "true";
    clearTimeout(this.later);
    this.later = setTimeout(() => history.replaceState(null, "", addressOf(state)), 300); // to be sent to others
  }

  // Show the state in the controls.
  update() {
    const { state, light, data } = this;
    const uniform = light?.uniform;
    this.show(CONTROLS.light, light ?? newLight(), (id) => !light || (uniform && ["azimuth", "elevation", "size"].includes(id)));
    this.show(CONTROLS.original, { originalStops: state.original?.stops ?? 0 }, () => !state.original);
    byId("original").checked = Boolean(state.original);
    this.show(CONTROLS.ambient, { ambient: ambientOf(state, data) }, () => hasAmbient(state.lights) || !(light || state.map));
    this.show(CONTROLS.map, state, () => !state.map);
    this.show(CONTROLS.image, { exposure: this.ev }, () => false);
    byId("envmap").value = this.maps.indexOf(state.map);
    byId("add").disabled = state.lights.length >= MOST_LIGHTS;
    for (const id of ["remove", "name", "tint", "uniform"]) byId(id).disabled = !light;
    if (document.activeElement !== byId("name")) byId("name").value = light?.name ?? "";
    byId("name").placeholder = light ? `light${state.selected + 1}` : "";
    byId("tint").value = hexOf(light?.rgb ?? [1, 1, 1]);
    byId("uniform").checked = Boolean(uniform);
    const pressed = { auto: state.exposure === null, background: state.background, compare: state.compare !== null };
    for (const [id, is] of Object.entries(pressed)) byId(id).ariaPressed = String(is);
    this.showLights();
    byId("command").textContent = commandOf(state, data, this.ev, this.ofAmbient);
    for (const id of ["before", "split", "sides"]) byId(id).hidden = state.compare === null;
    byId("before").style.clipPath = `inset(0 ${100 - state.compare}% 0 0)`;
    byId("split").value = state.compare;
  }

  // Show values in their controls, which work unless they are idle; what is being typed stays.
  show(controls, values, isIdle) {
    for (const [id, [, unit, , , step]] of Object.entries(controls)) {
      const value = rounded(values[id] * (SHOWN[id] ?? 1), step < 1 ? 2 : 1);
      const typed = byId(`${id}Typed`);
      byId(id).value = value;
      byId(id).setAttribute("aria-valuetext", `${value} ${unit}`);
      byId(id).disabled = typed.disabled = isIdle(id);
      if (document.activeElement !== typed) typed.value = value;
    }
  }

  // A button for each light in the panel, and a mark of it on the picture and on the ball.
  showLights() {
    const { lights, selected } = this.state;
    for (const place of [byId("chips"), ...this.pads()]) {
      const isList = place === byId("chips");
      const box = place.getBoundingClientRect();
      fill(place, lights.length, (i) => this.newMark(i)).forEach((mark, i) => {
        const light = lights[i];
        const where = light.uniform ? "uniform" : `azimuth ${Math.round(light.azimuth)}, elevation ${Math.round(light.elevation)} degrees`;
        mark.textContent = isList ? light.name || i + 1 : i + 1;
        mark.ariaLabel = `Light ${i + 1}${light.name && `, ${light.name}`}: ${where}`;
        mark.title = mark.ariaLabel;
        mark.ariaPressed = String(i === selected);
        mark.style.setProperty("--light", hexOf(rgbOf(light)));
        if (isList) return;
        const [x, y] = flatOf(light);
        const { left, top, radius } = this.middleOf(place, box);
        mark.hidden = light.uniform;
        mark.classList.toggle("behind", Math.hypot(x, y) > 1);
        mark.style.left = `${limited(left + radius * x, MARK_MARGIN, box.width - MARK_MARGIN)}px`;
        mark.style.top = `${limited(top - radius * y, MARK_MARGIN, box.height - MARK_MARGIN)}px`;
      });
    }
  }

  // What has marks: the picture and the ball.
  pads() {
    return [byId("marks"), byId("ball")];
  }

  // The middle of the head on one of them, from its corner, and the head's radius, in pixels.
  middleOf(pad, { width, height }) {
    const [x, y, radius] = pad === byId("ball") ? [0.5, 0.5, 0.25] : this.data.head;
    return { left: width * x, top: height * y, radius: radius * Math.min(width, height) };
  }

  newMark(i) {
    const mark = Object.assign(document.createElement("button"), { type: "button", className: "mark" });
    mark.onclick = mark.onfocus = () => this.change({ selected: i });
    return mark;
  }

  fillMaps() {
    byId("envmap").replaceChildren(new Option("None", -1), ...this.maps.map((map, i) => new Option(map.name, i)));
  }

  connect() {
    const on = (id, apply) => byId(id).addEventListener("input", (event) => apply(event.target.value));
    on("split", (percent) => this.change({ compare: Number(percent) }));
    on("envmap", (i) => this.change({ map: this.maps[i] ?? null }));
    on("presets", (name) => this.choose(name));
    on("name", (text) => this.rename(text.trim()));
    byId("name").addEventListener("blur", () => (byId("name").setCustomValidity(""), this.change({})));
    on("tint", (hex) => this.changeLight({ rgb: [1, 3, 5].map((i) => decoded(parseInt(hex.slice(i, i + 2), 16) / 255)) }));
    on("original", () => this.change({ original: byId("original").checked ? newLight({ name: ORIGINAL, original: true }) : null }));
    on("uniform", () => this.changeLight({ uniform: byId("uniform").checked }));
    const actions = {
      add: () => this.add(),
      remove: () => this.remove(),
      mirror: () => this.change({ lights: this.state.lights.map((light) => ({ ...light, azimuth: turned(-light.azimuth) })) }),
      auto: () => this.change({ exposure: this.state.exposure === null ? this.ev : null }),
      background: () => this.change({ background: !this.state.background }),
      compare: () => this.change({ compare: this.state.compare === null ? 50 : null }),
      showMarks: () => (byId("showMarks").ariaPressed = String(!(byId("marks").hidden = !byId("marks").hidden))),
      reset: () => this.load({ hash: "", search: "" }),
      copy: () => this.copy(),
      save: () => this.save(),
      open: () => byId("file").click(),
    };
    for (const [id, act] of Object.entries(actions)) byId(id).addEventListener("click", act);
    byId("file").addEventListener("change", (event) => this.open(event.target.files[0]));
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => (event.preventDefault(), this.open(event.dataTransfer.files[0])));
    addEventListener("hashchange", () => this.load(location));
    for (const begun of ["pointerdown", "keydown"]) addEventListener(begun, () => this.say(""), true); // until the next action
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("resize", () => this.change({}));
    for (const pad of this.pads()) this.listen(pad);
  }

  // A drag of a mark moves its light; elsewhere the chosen light comes from where one points.
  listen(pad) {
    let from = null; // of a drag: its pointer, and how far the mark's middle is from that
    const move = (event) => {
      const box = pad.getBoundingClientRect();
      const { left, top, radius } = this.middleOf(pad, box);
      const [x, y] = [event.clientX + from.x - box.left - left, box.top + top - event.clientY - from.y];
      this.changeLight({ ...azelAt(x / radius, y / radius), uniform: false });
    };
    pad.addEventListener("pointerdown", (event) => {
      if (event.button || from) return;
      event.preventDefault();
      const mark = event.target.closest(".mark");
      const box = mark?.getBoundingClientRect();
      from = { id: event.pointerId, x: 0, y: 0 };
      if (box) Object.assign(from, { x: box.left + box.width / 2 - event.clientX, y: box.top + box.height / 2 - event.clientY });
      pad.setPointerCapture(event.pointerId);
      (mark ?? byId("view")).focus({ preventScroll: true });
      if (mark) this.change({ selected: [...pad.children].indexOf(mark) });
      else {
        if (!this.light) this.add();
        move(event);
      }
    });
    pad.addEventListener("pointermove", (event) => event.pointerId === from?.id && move(event));
    for (const end of ["pointerup", "pointercancel"]) pad.addEventListener(end, () => (from = null));
  }

  // Arrows move the chosen light, but where they move a control; digits choose one, letters press buttons.
  key(event) {
    const isTyped = event.target.closest("select, input, summary") || (event.key.startsWith("Enter") && event.target.closest("button"));
    if (isTyped || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 1 : 5;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    const buttons = { a: "add", Delete: "remove", m: "mirror", b: "background", c: "compare", l: "showMarks" };
    if (moves[event.key] && this.light) {
      const [aside, up] = moves[event.key];
      const { azimuth, elevation } = this.light;
      this.changeLight(towards(azimuth + aside, elevation + up));
    } else if (this.state.lights[event.key - 1]) this.change({ selected: event.key - 1 });
    else if (buttons[event.key]) byId(buttons[event.key]).click();
    else return;
    event.preventDefault();
  }

  // Add a light where no other one is.
  add() {
    const { lights } = this.state;
    const isFree = ([x, y]) => lights.every((light) => Math.hypot(light.azimuth - x, light.elevation - y) > 10);
    const [azimuth, elevation] = PLACES.find(isFree) ?? PLACES[0];
    lights.push(newLight({ azimuth, elevation }));
    this.change({ selected: lights.length - 1 });
  }

  remove() {
    this.state.lights.splice(this.state.selected, 1);
    this.change({ selected: Math.max(0, this.state.selected - 1) });
  }

  // Take the lights of a preset in place of all others.
  choose(name) {
    byId("presets").value = "";
    const lights = lightsOf(name, this.data);
    this.say(lights.some(({ near }) => near) ? NEAR : "");
    this.change({ lights, original: null, selected: 0 });
  }

  rename(name) {
    const isTaken = allOf(this.state).some((light) => light !== this.light && light.name === name);
    const isGood = !name || (isName(name) && !isTaken);
    byId("name").setCustomValidity(isGood ? "" : "letters and digits, not a key of --light, and once");
    byId("name").reportValidity();
    if (isGood) this.changeLight({ name });
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
      Object.assign(link, { href: URL.createObjectURL(blob), download: `${this.data.title.replace(/\.\w+(?= |$)/, "")}_relit.png` });
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
