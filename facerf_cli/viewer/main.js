// The page: its data are decoded, then every change of the state is shown in the next frame.

const NO_LIGHT = "No light is on: add a light, or choose an environment.";

class Page {
  constructor(data, arrays, images) {
    this.photo = data.source;
    this.title = data.title;
    this.maps = data.envmaps.map(
      (one) => new LatLong(one.name, ...one.size, halvesOf(wordsOf(one.pixels)), one.command, one.path),
    );
    this.headAt = data.head.slice(0, 2);
    this.headRadius = data.head[2];
    this.field = new LightField(data, arrays, images, (text) => this.say(text));
    this.view = this.newView(data, arrays, images);
    this.ball = new Ball(byId("ball"));
    this.drawPhoto(images);
    this.state = readAddress(initialState(), location.hash, this.maps);
    this.ev = 0;
    this.panel = new Panel(this);
    addEventListener("hashchange", () => {
      readAddress(this.state, location.hash, this.maps);
      this.show();
    });
    addEventListener("resize", () => this.fit());
    this.frame();
  }

  newView(data, arrays, images) {
    const view = GpuView.create(byId("view"), data, arrays, images);
    if (view) return view;
    this.missing = "This browser has no WebGL2: the image is smaller and slower.";
    const fresh = byId("view").cloneNode();
    byId("view").replaceWith(fresh);
    return new CanvasView(fresh, data, arrays, images);
  }

  drawPhoto(images) {
    const canvas = byId("before");
    [canvas.width, canvas.height] = [images.photo.width, images.photo.height];
    canvas.getContext("2d").drawImage(images.photo, 0, 0);
  }

  say(text) {
    byId("message").textContent = text;
  }

  show() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.frame());
  }

  frame() {
    this.waiting = false;
    const { state, field } = this;
    const lights = state.lights.map((light) => ({ toward: directionOf(light.azimuth, light.elevation), rgb: rgbOf(light) }));
    const lit = field.under(lights, state.map, state.rotate, 2 ** state.mapStops);
    this.ev = state.exposure ?? lit.ev;
    this.view.light({ ...lit, gain: 2 ** this.ev });
    this.view.draw(state.background);
    document.body.dataset.settled = String(lit.exact);
    const dark = !state.lights.length && !state.map;
    if (dark) this.say(NO_LIGHT);
    else if (byId("message").textContent === NO_LIGHT) this.say("");
    if (!lit.exact) field.refine(lights, state.map, state.rotate, () => this.show());
    this.ball.draw(state, this.ev);
    this.panel.update();
    this.compare(state.compare);
    this.fit();
    this.remember();
  }

  // Show the photo left of a division at so many percent; null: nowhere.
  compare(percent) {
    for (const element of document.querySelectorAll("#before, #divider, #split, .left, .right")) element.hidden = percent === null;
    byId("before").style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
    byId("divider").style.left = `${percent}%`;
    byId("split").value = percent;
  }

  // While Space is held, the photo is shown.
  hold(held) {
    this.compare(held ? 100 : this.state.compare);
  }

  // The frame as large as the stage allows, with the photo's sides.
  fit() {
    const canvas = byId("before");
    byId("stage").style.setProperty("--sides", canvas.height / canvas.width);
    const stage = byId("stage").getBoundingClientRect();
    const room = this.state.panel ? 24 : 0;
    const scale = Math.min((stage.width - room) / canvas.width, (stage.height - room) / canvas.height);
    byId("frame").style.width = `${Math.floor(canvas.width * scale)}px`;
    byId("frame").style.height = `${Math.floor(canvas.height * scale)}px`;
  }

  // Keep the address up to date, so that it can be sent to others.
  remember() {
    clearTimeout(this.later);
    this.later = setTimeout(() => {
      try {
        history.replaceState(null, "", addressOf(this.state));
      } catch {
        return; // some browsers keep the address of a file fixed
      }
    }, 300);
  }

  save() {
    byId("view").toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${this.title}_relit.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
      this.say(`${link.download} is saved`);
    }, "image/png");
  }
}

async function start() {
  const data = JSON.parse(byId("data").textContent);
  const types = { maps: "jpeg", photo: "webp", fringe: "webp", matte: "png" };
  const images = {};
  for (const [name, type] of Object.entries(types)) images[name] = await imageOf(data[name], `image/${type}`);
  const page = new Page(data, await unpacked(data), images);
  page.say(page.missing ?? "");
}

start().catch((error) => {
  byId("message").textContent = `The page cannot be shown: ${error.message}`;
});
