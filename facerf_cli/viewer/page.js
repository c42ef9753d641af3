// The page: an image under any light is guide * sum over lights of weight * ratio (basis.py), drawn by WebGL2.

const MOST_LIGHTS = 9;
const SHOULDER = 0.8; // brightest channel from which on the soft view bends a colour (image/colour.py)
const WHITENING = 0.3;
// Of new lights: azimuth and elevation.
const PLACES = [[-60, 10], [40, 25], [145, 25], [-145, 25], [0, 80], [75, -10], [-90, 40], [0, -50], [180, 15]];

// ---- The image: by WebGL2, or by the same formulas on a 2D canvas ----

const HEADER = `#version 300 es
precision highp float;
precision highp sampler2DArray;
`;
const VERTEX = `#version 300 es
void main() { gl_Position = vec4(ivec2(gl_VertexID & 1, gl_VertexID >> 1) * 4 - 1, 0, 1); }`;
const WEIGH = `${HEADER}
uniform sampler2DArray ratios;
uniform sampler2D weights;
out vec4 sum;
void main() {
  sum = vec4(0, 0, 0, 1);
  for (int light = 0; light < textureSize(weights, 0).x; light++) {
    vec3 weight = texelFetch(weights, ivec2(light, 0), 0).rgb;
    if (weight == vec3(0)) continue;
    vec3 root = texelFetch(ratios, ivec3(gl_FragCoord.xy, light), 0).rgb;
    sum.rgb += weight * root * root;
  }
}`;
const COMPOSE = `${HEADER}
uniform sampler2D guide, plate, matte, sum;
uniform float white, keep; // linear value of the guide's white; 1 over the background, 0 over nothing
out vec4 colour;
vec3 decoded(vec3 x) { return mix(x / 12.92, pow((x + 0.055) / 1.055, vec3(2.4)), step(0.04045, x)); }
vec3 encoded(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
vec3 softened(vec3 x) {
  float brightest = max(max(x.r, x.g), x.b);
  if (brightest <= ${SHOULDER}) return x;
  float bent = 1.0 - ${1 - SHOULDER} * exp((${SHOULDER} - brightest) / ${1 - SHOULDER});
  return bent + (x * (bent / brightest) - bent) / (1.0 + ${WHITENING} * (brightest - bent));
}
void main() {
  vec2 size = vec2(textureSize(guide, 0));
  ivec2 at = ivec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  float share = texelFetch(matte, at, 0).r;
  vec3 person = white * decoded(texelFetch(guide, at, 0).rgb) * texture(sum, (vec2(at) + 0.5) / size).rgb;
  vec3 mixed = decoded(texelFetch(plate, at, 0).rgb) + person;
  vec3 shown = keep > 0.0 ? mix(mixed, softened(mixed), share) : softened(person / max(share, 0.001));
  float alpha = max(share, keep);
  colour = vec4(encoded(shown) * alpha, alpha);
}`;

class GpuView {
  // Null where the browser has no WebGL2 that draws into floats, or not as large.
  static create(canvas, data, images) {
    const gl = canvas.getContext("webgl2", { preserveDrawingBuffer: true, antialias: false });
    if (!gl?.getExtension("EXT_color_buffer_float")) return null;
    const wide = Math.max(...data.size) > gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const deep = data.scales.length > gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS);
    return wide || deep ? null : new GpuView(gl, data, images);
  }

  constructor(gl, data, images) {
    Object.assign(this, { gl, data });
    [gl.canvas.width, gl.canvas.height] = data.size;
    this.weigh = this.program(WEIGH);
    this.compose = this.program(COMPOSE);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    this.images = Object.fromEntries(["guide", "plate", "matte"].map((name) => [name, this.texture(gl.NEAREST)]));
    for (const [name, made] of Object.entries(this.images)) {
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, images[name]);
    }
    this.weights = this.texture(gl.NEAREST);
    this.images.sum = this.texture(gl.LINEAR);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, ...data.small);
    this.buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.images.sum, 0);
    this.ratios = this.texture(gl.NEAREST, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, ...data.small, data.scales.length);
  }

  // Take the bytes of a light's ratio [h, w, 4].
  add(light, pixels) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.ratios);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, light, ...this.data.small, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  }

  // Draw the sum by weights [lights * 3], over the photo's background or over nothing.
  draw(weights, withBackground) {
    const { gl, data } = this;
    const count = weights.length / 3;
    const texels = Float32Array.from({ length: 4 * count }, (_, i) => (i % 4 < 3 ? weights[3 * (i >> 2) + (i % 4)] : 0));
    gl.bindTexture(gl.TEXTURE_2D, this.weights);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, count, 1, 0, gl.RGBA, gl.FLOAT, texels);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    this.run(this.weigh, data.small, { weights: this.weights, ratios: this.ratios });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.compose);
    gl.uniform1f(gl.getUniformLocation(this.compose, "white"), data.white);
    gl.uniform1f(gl.getUniformLocation(this.compose, "keep"), withBackground ? 1 : 0);
    this.run(this.compose, data.size, this.images);
  }

  run(program, size, textures) {
    const { gl } = this;
    gl.useProgram(program);
    gl.viewport(0, 0, ...size);
    Object.entries(textures).forEach(([name, made], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(made === this.ratios ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, made);
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  texture(filter, kind = this.gl.TEXTURE_2D) {
    const { gl } = this;
    const made = gl.createTexture();
    gl.bindTexture(kind, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return made;
  }

  program(fragment) {
    const { gl } = this;
    const made = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || "no shader");
    return made;
  }
}

// The same, by the processor and as small as the ratios.
class CanvasView {
  constructor(canvas, data, images) {
    Object.assign(this, { data, ratios: [] });
    [canvas.width, canvas.height] = data.small;
    this.context = canvas.getContext("2d");
    for (const name of ["guide", "plate", "matte"]) this[name] = pixelsOf(images[name], ...data.small);
  }

  add(light, pixels) {
    this.ratios[light] = pixels;
  }

  draw(weights, withBackground) {
    const shown = this.context.createImageData(...this.data.small);
    const sum = new Float32Array(shown.data.length);
    this.ratios.forEach((ratio, light) => {
      const rgb = weights.subarray(3 * light, 3 * light + 3).map((value) => value / 255 ** 2);
      if (!rgb.some(Boolean)) return;
      for (let i = 0; i < sum.length; i += 4) for (let c = 0; c < 3; c++) sum[i + c] += rgb[c] * ratio[i + c] ** 2;
    });
    for (let at = 0; at < sum.length; at += 4) shown.data.set(this.pixel(at, sum, withBackground), at);
    this.context.putImageData(shown, 0, 0);
  }

  pixel(at, sum, withBackground) {
    const share = this.matte[at] / 255;
    const person = [0, 1, 2].map((c) => this.data.white * decoded(this.guide[at + c] / 255) * sum[at + c]);
    if (!withBackground) {
      const alone = softened(person.map((value) => value / Math.max(share, 0.001)));
      return [...alone.map((value) => 255 * encoded(value)), 255 * share];
    }
    const mixed = person.map((value, c) => decoded(this.plate[at + c] / 255) + value);
    const soft = softened(mixed);
    return [...mixed.map((value, c) => 255 * encoded(value + share * (soft[c] - value))), 255];
  }
}

function softened(colour) {
  const brightest = Math.max(...colour);
  if (brightest <= SHOULDER) return colour;
  const bent = 1 - (1 - SHOULDER) * Math.exp((SHOULDER - brightest) / (1 - SHOULDER));
  return colour.map((value) => bent + ((value * bent) / brightest - bent) / (1 + WHITENING * (brightest - bent)));
}

// ---- The exposure of `facerf relight --exposure auto`: the face as bright as in the photo ----

class AutoExposure {
  // `face` and `person` of the data with their images of square roots, a row a light.
  constructor(about, images) {
    this.about = about;
    for (const name of ["face", "person"]) {
      if (!about[name]) continue;
      const { scales, shares, total } = about[name];
      const size = [images[name].naturalWidth, scales.length];
      const roots = pixelsOf(images[name], ...size).filter((_, i) => i % 4 === 0);
      this[name] = { scales, shares: floatsOf(shares), total, roots };
    }
  }

  // The percentile of luminance of a region under weights [lights * 3].
  bright({ scales, shares, total, roots }, weights, percent) {
    const [count, sums] = [shares.length / 3, new Float32Array(shares.length)];
    if (!count) return 0;
    scales.forEach((scale, light) => {
      const rgb = Array.from(weights.subarray(3 * light, 3 * light + 3), (value) => (value * scale) / 255 ** 2);
      if (!rgb.some(Boolean)) return;
      for (let i = 0; i < count; i++) {
        const power = roots[light * count + i] ** 2;
        for (let c = 0; c < 3; c++) sums[3 * i + c] += rgb[c] * power;
      }
    });
    const values = Float32Array.from({ length: count }, (_, i) => dot(shares.subarray(3 * i), sums.subarray(3 * i)));
    const sorted = values.sort();
    const at = Math.max(0, count - 1 - (total - 1) * (1 - percent / 100)); // they are the brightest of the total
    const [low, high] = [sorted[Math.floor(at)], sorted[Math.ceil(at)]];
    return low + (at - Math.floor(at)) * (high - low);
  }

  // EV to two decimals under weights [lights * 3].
  ev(weights) {
    const { plate, target, mostOverFront, facePercentile, personPercentile } = this.about;
    const person = this.bright(this.person, weights, personPercentile);
    const face = plate ? this.bright(this.face, weights, facePercentile) : target;
    if (Math.min(face, person, plate ? plate[0] : 1) < 1e-9) return 0;
    const gain = plate ? Math.min(plate[0] / face, (2 * Math.max(1, plate[1])) / person) : target / person;
    let strength = 0;
    for (let i = 0; i < weights.length; i += 3) strength += luminance(weights.subarray(i, i + 3));
    return Math.round(100 * Math.min(Math.log2(gain), mostOverFront - Math.log2(strength))) / 100;
  }
}

// ---- What is shown: in the address, and as a command ----

const newLight = (azimuth, elevation, colour = "#ffffff", stops = 0) => ({ azimuth, elevation, colour, stops });
const byteText = (value) => Math.round(255 * encoded(value)).toString(16).padStart(2, "0");
const hexOf = (rgb) => "#" + rgb.map(byteText).join("");
const rounded = (value, digits) => Number(value.toFixed(digits));

// Linear rgb [3] of a light: its colour, as shown on a screen, times its intensity.
function rgbOf(light) {
  const rgb = light.rgb ?? [1, 3, 5].map((i) => decoded(parseInt(light.colour.slice(i, i + 2), 16) / 255));
  return rgb.map((value) => value * 2 ** light.stops);
}

// The lights of "az,el[,r,g,b][;...]", as --light takes them; null where it is none.
function lightsOf(text) {
  const all = (text ?? "").split(";").slice(0, MOST_LIGHTS).map((part) => part.split(",").map(Number));
  if (all.some((values) => ![2, 5].includes(values.length) || !values.every(Number.isFinite))) return null;
  return all.map(([azimuth, elevation, ...rgb]) => {
    const light = newLight(turned(azimuth), limited(elevation, -90, 90));
    if (!rgb.length) return light;
    light.rgb = rgb.map((value) => Math.max(0, value));
    return { ...light, colour: hexOf(light.rgb.map((value) => value / Math.max(...light.rgb, 1e-6))) };
  });
}

function lightText(light) {
  const rgb = rgbOf(light).map((value) => Number(value.toPrecision(4)));
  const where = [rounded(light.azimuth, 1), rounded(light.elevation, 1)];
  return (rgb.every((value) => value === 1) ? where : [...where, ...rgb]).join(",");
}

// Read ?light=... or #light=75,20;-120,10&env=studio&rotate=30&mapstops=-1&ev=-0.5&background=none&compare=50
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
    map,
    rotate: turned(number("rotate", -3600, 3600) ?? 0),
    mapStops: number("mapstops", -6, 6) ?? 0,
    exposure: number("ev", -20, 20), // null: automatic
    background: given.get("background") !== "none",
    compare: number("compare", 0, 100), // percent of the frame that shows the photo; null: none
  };
}

function addressOf(state) {
  const parts = state.lights.length ? ["light=" + state.lights.map(lightText).join(";")] : [];
  if (state.map?.command) {
    parts.push("env=" + state.map.name);
    if (state.rotate) parts.push("rotate=" + state.rotate);
    if (state.mapStops) parts.push("mapstops=" + state.mapStops);
  }
  if (state.exposure !== null) parts.push("ev=" + state.exposure);
  if (!state.background) parts.push("background=none");
  if (state.compare !== null) parts.push("compare=" + state.compare);
  return "#" + parts.join("&");
}

// The command lines that make the same image.
function commandOf(state, data, ev) {
  const { map, lights } = state;
  if (!map && !lights.length) return "# add a light, or choose an environment";
  const quoted = (text) => (/^[\w@%+=:,./-]+$/.test(text) ? text : "'" + text.replaceAll("'", `'"'"'`) + "'");
  let line = `facerf relight ${data.source}`;
  if (map) line += ` --envmap ${quoted(map.path)}` + (state.rotate ? ` --rotate ${state.rotate}` : "");
  if (lights.length) line += ` --light '${lights.map(lightText).join(";")}'`;
  const both = Boolean(map) && lights.length > 0;
  const stops = map && !both ? state.mapStops : 0; // of a map alone: they are exposure
  line += ` --exposure ${rounded(ev + stops, 2)}`;
  if (data.background && !state.background) line += " --background none";
  const lines = [...(map?.command ? [map.command] : []), line + " -o out"];
  const scale = state.mapStops ? `, that of the map times ${Number((2 ** state.mapStops).toPrecision(3))}` : "";
  if (both) lines.push(`# the map and the lights are two images: add their EXRs${scale}`);
  return lines.join("\n");
}

// ---- The page: controls change the state; every change is shown in the next frame ----

class Page {
  constructor(data, images, ratios) {
    this.data = data;
    this.rig = new Rig(data);
    const mapOf = ({ name, size, pixels, command, path }) => new LatLong(name, ...size, floatsOf(pixels), command, path);
    this.maps = data.envmaps.map(mapOf);
    this.auto = new AutoExposure(data.exposure, images);
    this.view = this.newView(images);
    ratios.forEach((image, light) => this.view.add(light, pixelsOf(image, ...data.small)));
    byId("before").src = images.photo.src;
    byId("frame").style.setProperty("--sides", data.size[0] / data.size[1]);
    this.state = stateOf(location, this.maps);
    this.connect();
    this.fillMaps();
    this.frame();
  }

  newView(images) {
    const view = GpuView.create(byId("view"), this.data, images);
    if (view) return view;
    this.say("This browser has no WebGL2: the image is smaller and slower.");
    const fresh = byId("view").cloneNode();
    byId("view").replaceWith(fresh);
    return new CanvasView(fresh, this.data, images);
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

  // Weights [lights * 3] of all that shines.
  weights() {
    const { lights, map, rotate, mapStops } = this.state;
    const key = map && `${this.maps.indexOf(map)} ${rotate}`;
    if (map && key !== this.mapKey) [this.mapKey, this.mapWeights] = [key, this.rig.mapWeights(map, rotate)];
    const dark = new Float64Array(3 * this.rig.lights.length);
    const weights = map ? this.mapWeights.map((value) => value * 2 ** mapStops) : dark;
    for (const light of lights) {
      const [rgb, around] = [rgbOf(light), this.rig.around(directionOf(light.azimuth, light.elevation))];
      for (const [i, share] of around) rgb.forEach((value, c) => (weights[3 * i + c] += share * value));
    }
    return weights;
  }

  frame() {
    this.waiting = null;
    const { state, data } = this;
    const weights = this.weights();
    this.ev = state.exposure ?? this.auto.ev(weights);
    const scaled = weights.map((value, i) => value * data.scales[Math.floor(i / 3)] * 2 ** this.ev);
    this.view.draw(scaled, state.background && data.background);
    this.update();
    document.body.dataset.settled = "true";
    clearTimeout(this.later);
    this.later = setTimeout(() => history.replaceState(null, "", addressOf(state)), 300); // to be sent to others
  }

  // Show the state in the controls.
  update() {
    const { state, light, data } = this;
    const set = (id, value, text) => {
      byId(id).value = value;
      byId(id).setAttribute("aria-valuetext", text);
      document.querySelector(`output[for="${id}"]`).textContent = text;
    };
    const signed = (value, digits, unit) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)} ${unit}`;
    set("azimuth", light?.azimuth ?? 0, light ? `${Math.round(light.azimuth)}°` : "–");
    set("elevation", light?.elevation ?? 0, light ? `${Math.round(light.elevation)}°` : "–");
    set("stops", light?.stops ?? 0, light ? signed(light.stops, 1, "stops") : "–");
    set("colour", light?.colour ?? "#ffffff", light?.colour ?? "–");
    set("rotate", state.rotate, `${Math.round(state.rotate)}°`);
    set("map-stops", state.mapStops, signed(state.mapStops, 1, "stops"));
    set("exposure", this.ev, signed(this.ev, 2, "EV"));
    set("envmap", this.maps.indexOf(state.map), state.map?.name ?? "none");
    for (const id of ["azimuth", "elevation", "stops", "colour", "remove"]) byId(id).disabled = !light;
    for (const id of ["rotate", "map-stops"]) byId(id).disabled = !state.map;
    byId("add").disabled = state.lights.length >= MOST_LIGHTS;
    byId("background").hidden = !data.background;
    const pressed = { auto: state.exposure === null, background: state.background, compare: state.compare !== null };
    for (const [id, is] of Object.entries(pressed)) byId(id).setAttribute("aria-pressed", String(is));
    byId("chips").replaceChildren(...state.lights.map((one, i) => this.chip(one, i)));
    byId("command").textContent = commandOf(state, data, this.ev);
    this.compare(state.compare);
  }

  chip(light, i) {
    const chip = Object.assign(document.createElement("button"), { type: "button", textContent: i + 1 });
    chip.style.setProperty("--light", light.colour);
    const [azimuth, elevation] = [light.azimuth, light.elevation].map(Math.round);
    chip.setAttribute("aria-label", `Light ${i + 1}: azimuth ${azimuth}, elevation ${elevation}`);
    chip.setAttribute("aria-pressed", String(i === this.state.selected));
    chip.onclick = () => this.change({ selected: i });
    return chip;
  }

  // Show the photo left of a division at so many percent; null: nowhere.
  compare(percent) {
    for (const element of document.querySelectorAll("#before, #split")) element.hidden = percent === null;
    byId("before").style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
    byId("split").value = percent;
  }

  fillMaps() {
    byId("envmap").replaceChildren(new Option("None", -1), ...this.maps.map((map, i) => new Option(map.name, i)));
  }

  connect() {
    const change = (id, apply) => byId(id).addEventListener("input", (event) => apply(Number(event.target.value)));
    change("azimuth", (azimuth) => this.changeLight({ azimuth }));
    change("elevation", (elevation) => this.changeLight({ elevation }));
    change("stops", (stops) => this.changeLight({ stops }));
    change("rotate", (rotate) => this.change({ rotate }));
    change("map-stops", (mapStops) => this.change({ mapStops }));
    change("exposure", (exposure) => this.change({ exposure }));
    change("split", (compare) => this.change({ compare }));
    change("envmap", (map) => this.change({ map: this.maps[map] ?? null }));
    const colour = (event) => this.changeLight({ colour: event.target.value, rgb: undefined });
    byId("colour").addEventListener("input", colour);
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
    this.connectDragging();
  }

  // The light comes from where one points: as far from the head's middle as on a ball around it.
  connectDragging() {
    const view = byId("view");
    const [headX, headY, headRadius] = this.data.head;
    const move = (event) => {
      const box = view.getBoundingClientRect();
      const radius = headRadius * Math.min(box.width, box.height);
      const x = (event.clientX - box.left - box.width * headX) / radius;
      const y = (box.top + box.height * headY - event.clientY) / radius;
      const ring = Math.hypot(x, y) || 1;
      const angle = Math.min(ring, 1.95) * 90 * DEGREE;
      const toward = [(Math.sin(angle) * x) / ring, (Math.sin(angle) * y) / ring, Math.cos(angle)];
      const [azimuth, elevation] = [Math.atan2(toward[0], toward[2]), Math.asin(toward[1])];
      this.changeLight({ azimuth: Math.round(azimuth / DEGREE), elevation: Math.round(elevation / DEGREE) });
    };
    view.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      view.setPointerCapture(event.pointerId);
      if (!this.light) this.add();
      move(event);
    });
    view.addEventListener("pointermove", (event) => view.hasPointerCapture(event.pointerId) && move(event));
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
    const isFree = ([x, y]) => this.state.lights.every((light) => Math.hypot(light.azimuth - x, light.elevation - y) > 10);
    this.state.lights.push(newLight(...(PLACES.find(isFree) ?? PLACES[0])));
    this.change({ selected: this.state.lights.length - 1 });
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
  for (const name of ["face", "person"]) {
    if (data.exposure[name]) images[name] = await imageOf(data.exposure[name].roots, "webp");
  }
  const ratios = await Promise.all(data.ratios.map((ratio) => imageOf(ratio, "jpeg")));
  byId("message").textContent = "";
  new Page(data, images, ratios);
}

start().catch((error) => (byId("message").textContent = `The page cannot be shown: ${error.message}`));
