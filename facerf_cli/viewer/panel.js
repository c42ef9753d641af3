// The panel, the keyboard and dragging: each changes the state and asks for it to be shown.

const COARSE_DEG = 5;
const QUARTER = 0.25;
const PLACES = [[-60, 10], [40, 25], [145, 25], [-145, 25], [0, 80], [75, -10], [-90, 40], [0, -50], [180, 15]]; // of new lights
const APART_DEG = 10;

function byId(id) {
  return document.getElementById(id);
}

class Panel {
  // `page` has state, maps, show(), save() and the photo's command-line name.
  constructor(page) {
    this.page = page;
    this.fillMaps();
    this.connectSliders();
    this.connectButtons();
    this.connectFiles();
    this.connectDragging();
    document.addEventListener("keydown", (event) => this.key(event));
    byId("hint").hidden = Boolean(location.hash);
    const hide = () => (byId("hint").hidden = true);
    for (const kind of ["pointerdown", "keydown"]) document.addEventListener(kind, hide, { once: true });
    document.addEventListener("keyup", (event) => event.key === " " && page.hold(false));
  }

  get state() {
    return this.page.state;
  }

  get light() {
    return this.state.lights[this.state.selected];
  }

  change(values) {
    Object.assign(this.state, values);
    this.page.show();
  }

  changeLight(values) {
    if (!this.light) return;
    Object.assign(this.light, values);
    this.page.show();
  }

  fillMaps() {
    const select = byId("envmap");
    select.length = 1;
    this.page.maps.forEach((map, index) => {
      const option = new Option(map.name, String(index + 1));
      select.add(option);
    });
  }

  connectSliders() {
    const on = (id, apply) => byId(id).addEventListener("input", (event) => apply(event.target.value));
    on("azimuth", (value) => this.changeLight({ azimuth: Number(value) }));
    on("elevation", (value) => this.changeLight({ elevation: Number(value) }));
    on("stops", (value) => this.changeLight({ stops: Number(value) }));
    on("colour", (value) => this.changeLight({ colour: value, rgb: undefined }));
    on("rotate", (value) => this.change({ rotate: Number(value) }));
    on("map-stops", (value) => this.change({ mapStops: Number(value) }));
    on("exposure", (value) => this.change({ exposure: Number(value) }));
    on("split", (value) => this.change({ compare: Number(value) }));
    on("envmap", (value) => this.change({ map: value ? this.page.maps[Number(value) - 1] : null }));
  }

  connectButtons() {
    const on = (id, act) => byId(id).addEventListener("click", act);
    on("add", () => this.add());
    on("remove", () => this.remove());
    on("auto", () => this.toggleAuto());
    on("background", () => this.change({ background: !this.state.background }));
    on("compare", () => this.change({ compare: this.state.compare === null ? 50 : null }));
    on("copy", () => this.copy());
    on("save", () => this.page.save());
    on("open", () => byId("file").click());
    on("help-open", () => byId("help").showModal());
    on("help-close", () => byId("help").close());
    for (const button of document.querySelectorAll("[data-place]")) {
      const [azimuth, elevation] = button.dataset.place.split(",").map(Number);
      button.addEventListener("click", () => (this.light ? this.changeLight({ azimuth, elevation }) : this.add(azimuth, elevation)));
    }
  }

  connectFiles() {
    byId("file").addEventListener("change", (event) => this.open(event.target.files[0]));
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      this.open(event.dataTransfer.files[0]);
    });
  }

  async open(file) {
    if (!file) return;
    try {
      const map = await readMap(file);
      this.page.maps.push(map);
      this.fillMaps();
      this.page.say(`${map.name} is the environment now`);
      this.change({ map });
    } catch (error) {
      const reason = error instanceof RangeError ? "the map is cut short; copy it again" : error.message;
      this.page.say(`${file.name}: ${reason.replace(`${file.name}: `, "")}`);
    }
  }

  // Add a light, where no other one is.
  add(azimuth, elevation) {
    if (this.state.lights.length >= MOST_LIGHTS) return;
    if (azimuth === undefined) {
      const near = (light, place) => Math.hypot(light.azimuth - place[0], light.elevation - place[1]) < APART_DEG;
      const open = PLACES.filter((place) => !this.state.lights.some((light) => near(light, place)));
      [azimuth, elevation] = open[0] ?? PLACES[0];
    }
    this.state.lights.push(newLight(azimuth, elevation));
    this.change({ selected: this.state.lights.length - 1 });
  }

  remove() {
    this.state.lights.splice(this.state.selected, 1);
    this.change({ selected: Math.max(0, Math.min(this.state.selected, this.state.lights.length - 1)) });
  }

  toggleAuto() {
    this.change({ exposure: this.state.exposure === null ? this.page.ev : null });
  }

  async copy() {
    try {
      await navigator.clipboard.writeText(byId("command").textContent);
      this.page.say("The command is copied");
    } catch {
      getSelection().selectAllChildren(byId("command"));
      this.page.say("Press Ctrl+C to copy the selected command");
    }
  }

  // Over the face a light comes from where one points: as far from the frame's middle as on a ball around the
  // head, whose outline is the side; on the mirror ball from where that reflects.
  connectDragging() {
    const overFace = (event, box) => {
      const half = this.page.headRadius * Math.min(box.width, box.height);
      const [cx, cy] = [box.left + box.width * this.page.headAt[0], box.top + box.height * this.page.headAt[1]];
      const [x, y] = [(event.clientX - cx) / half, (cy - event.clientY) / half];
      const angle = Math.min(Math.hypot(x, y), 1.95) * 90 * DEGREE;
      const ring = Math.hypot(x, y) || 1;
      return [(Math.sin(angle) * x) / ring, (Math.sin(angle) * y) / ring, Math.cos(angle)];
    };
    const overBall = (event, box) => {
      const [x, y] = ballPoint(event, box);
      return reflectedAt(x, y);
    };
    this.drag(byId("view"), overFace);
    this.drag(byId("ball"), overBall, (event, box) => this.pick(ballPoint(event, box)));
  }

  drag(element, toward, start) {
    const move = (event) => {
      const [azimuth, elevation] = azimuthElevation(toward(event, element.getBoundingClientRect()));
      this.changeLight({ azimuth: Math.round(azimuth), elevation: Math.round(elevation) });
    };
    element.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      element.setPointerCapture(event.pointerId);
      if (start) start(event, element.getBoundingClientRect());
      if (!this.light) this.add();
      move(event);
    });
    element.addEventListener("pointermove", (event) => element.hasPointerCapture(event.pointerId) && move(event));
  }

  // Select the light under a point of the ball.
  pick([x, y]) {
    const distances = this.state.lights.map((light) => {
      const [lx, ly] = placeOf(directionOf(light.azimuth, light.elevation));
      return Math.hypot(lx - x, ly - y);
    });
    const nearest = distances.indexOf(Math.min(...distances));
    if (distances[nearest] < 0.15) this.state.selected = nearest;
  }

  key(event) {
    const typing = event.target.closest("select, dialog, input:not([type=range])");
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const onSlider = event.target.matches("input[type=range]");
    const onButton = event.target.matches("button");
    const step = event.shiftKey ? 1 : COARSE_DEG;
    const arrows = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (arrows[event.key] && !onSlider && this.light) {
      const [azimuth, elevation] = arrows[event.key];
      this.changeLight({
        azimuth: turned(this.light.azimuth + azimuth),
        elevation: limited(this.light.elevation + elevation, -90, 90),
      });
    } else if (event.key === " " && !onButton && !event.repeat) this.page.hold(true);
    else if (!arrows[event.key] && !this.letter(event.key)) return;
    if (!(onSlider && arrows[event.key]) && !(onButton && event.key === " ")) event.preventDefault();
  }

  // True if a key means something.
  letter(key) {
    const { state, page } = this;
    const ev = (step) => this.change({ exposure: limited(page.ev + step, -20, 20) });
    const actions = {
      "+": () => ev(QUARTER),
      "=": () => ev(QUARTER),
      "-": () => ev(-QUARTER),
      a: () => this.toggleAuto(),
      b: () => this.change({ background: !state.background }),
      c: () => this.change({ compare: state.compare === null ? 50 : null }),
      h: () => this.change({ panel: !state.panel }),
      k: () => this.copy(),
      m: () => this.nextMap(),
      n: () => this.add(),
      s: () => page.save(),
      ",": () => this.changeLight({ stops: limited((this.light?.stops ?? 0) - QUARTER, -6, 6) }),
      ".": () => this.changeLight({ stops: limited((this.light?.stops ?? 0) + QUARTER, -6, 6) }),
      "[": () => this.change({ rotate: turned(state.rotate - COARSE_DEG) }),
      "]": () => this.change({ rotate: turned(state.rotate + COARSE_DEG) }),
      "?": () => byId("help").showModal(),
      Delete: () => this.remove(),
      Backspace: () => this.remove(),
    };
    if (/^[1-9]$/.test(key) && Number(key) <= state.lights.length) this.change({ selected: Number(key) - 1 });
    else if (actions[key]) actions[key]();
    else return false;
    return true;
  }

  nextMap() {
    const index = this.page.maps.indexOf(this.state.map) + 1;
    this.change({ map: this.page.maps[index] ?? null });
  }

  // Show the state in the controls.
  update() {
    const { state, light } = this;
    this.chips();
    const set = (id, value, text) => {
      const input = byId(id);
      if (document.activeElement !== input || input.type !== "range") input.value = value;
      const output = document.querySelector(`output[for="${id}"]`);
      if (output) output.textContent = text;
      input.setAttribute("aria-valuetext", text);
    };
    set("azimuth", light?.azimuth ?? 0, light ? `${Math.round(light.azimuth)}°` : "–");
    set("elevation", light?.elevation ?? 0, light ? `${Math.round(light.elevation)}°` : "–");
    set("stops", light?.stops ?? 0, light ? signed(light.stops, 1, "stops") : "–");
    set("colour", light?.colour ?? "#ffffff", light?.colour ?? "–");
    set("rotate", state.rotate, `${Math.round(state.rotate)}°`);
    set("map-stops", state.mapStops, signed(state.mapStops, 1, "stops"));
    set("exposure", this.page.ev, signed(this.page.ev, 2, "EV"));
    set("envmap", String(this.page.maps.indexOf(state.map) + 1 || ""), "");
    for (const id of ["azimuth", "elevation", "stops", "colour", "remove"]) byId(id).disabled = !light;
    for (const id of ["rotate", "map-stops"]) byId(id).disabled = !state.map;
    byId("add").disabled = state.lights.length >= MOST_LIGHTS;
    byId("auto").setAttribute("aria-pressed", String(state.exposure === null));
    byId("background").setAttribute("aria-pressed", String(state.background));
    byId("compare").setAttribute("aria-pressed", String(state.compare !== null));
    byId("command").textContent = commandOf(state, this.page.photo, this.page.ev);
    document.body.classList.toggle("bare", !state.panel);
  }

  chips() {
    const box = byId("chips");
    while (box.children.length > this.state.lights.length) box.lastChild.remove();
    this.state.lights.forEach((light, i) => {
      let chip = box.children[i];
      if (!chip) {
        chip = box.appendChild(document.createElement("button"));
        chip.type = "button";
        chip.className = "chip";
        chip.setAttribute("role", "radio");
        chip.append(document.createElement("i"), document.createElement("span"));
        chip.addEventListener("click", () => this.change({ selected: i }));
      }
      chip.firstChild.style.background = light.colour;
      chip.lastChild.textContent = `${i + 1}`;
      chip.setAttribute("aria-label", `Light ${i + 1}: azimuth ${Math.round(light.azimuth)}, elevation ${Math.round(light.elevation)}`);
      chip.setAttribute("aria-checked", String(i === this.state.selected));
    });
  }
}

function ballPoint(event, box) {
  return [((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2];
}

function signed(value, digits, unit) {
  const text = Math.abs(value).toFixed(digits);
  return `${value < 0 ? "−" : "+"}${text} ${unit}`;
}
