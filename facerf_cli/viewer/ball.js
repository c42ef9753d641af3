// The mirror ball: the map as a mirror shows it, and a handle for each light. Its centre reflects what is in
// front of the head, its edge what is behind.

const BALL_PX = 220;

// The direction that the ball reflects at (x, y) in -1..1, y up; beyond the edge that of the edge.
function reflectedAt(x, y) {
  const radius = Math.min(Math.hypot(x, y), 0.9999);
  const scale = radius / Math.max(Math.hypot(x, y), 1e-9);
  const normal = [x * scale, y * scale, Math.sqrt(1 - radius * radius)];
  return normal.map((value, i) => 2 * normal[2] * value - (i === 2 ? 1 : 0));
}

// The place (x, y) on the ball, y up, that reflects a direction.
function placeOf([x, y, z]) {
  const length = Math.sqrt(Math.max(2 + 2 * z, 1e-9));
  const ring = Math.hypot(x, y);
  const radius = Math.min(ring / length, 1);
  return ring < 1e-6 ? [z < 0 ? 1 : 0, 0] : [(x / ring) * radius, (y / ring) * radius];
}

class Ball {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.mirror = document.createElement("canvas");
    this.mirror.width = this.mirror.height = BALL_PX;
    this.shown = null;
  }

  draw(state, ev) {
    const key = [state.map && state.map.name, state.rotate, state.mapStops, ev.toFixed(1)].join();
    if (key !== this.shown) this.reflect(state, ev);
    this.shown = key;
    const size = this.canvas.width;
    this.context.clearRect(0, 0, size, size);
    this.context.drawImage(this.mirror, 0, 0, size, size);
    state.lights.forEach((light, i) => this.handle(light, i === state.selected, size));
  }

  reflect(state, ev) {
    const context = this.mirror.getContext("2d");
    const image = context.createImageData(BALL_PX, BALL_PX);
    const gain = state.map ? 2 ** (ev + state.mapStops) : 0;
    for (let row = 0; row < BALL_PX; row++) {
      for (let column = 0; column < BALL_PX; column++) {
        const [x, y] = [((column + 0.5) / BALL_PX) * 2 - 1, 1 - ((row + 0.5) / BALL_PX) * 2];
        const radius = Math.hypot(x, y);
        const at = 4 * (row * BALL_PX + column);
        const shape = Math.sqrt(Math.max(0, 1 - radius * radius)) * 0.035 + 0.015;
        const seen = gain ? state.map.look(reflectedAt(x, y), state.rotate) : [0, 0, 0];
        for (let c = 0; c < 3; c++) image.data[at + c] = 255 * encoded(gain * seen[c] + (gain ? 0 : shape));
        image.data[at + 3] = 255 * Math.min(1, Math.max(0, (1 - radius) * BALL_PX * 0.5));
      }
    }
    context.putImageData(image, 0, 0);
    if (!gain) this.rings(context);
  }

  // Circles at 90 degrees, and the axes: where the side of the head begins.
  rings(context) {
    const half = BALL_PX / 2;
    context.strokeStyle = "rgba(255, 255, 255, 0.16)";
    context.beginPath();
    context.arc(half, half, half * Math.SQRT1_2, 0, 2 * Math.PI);
    context.moveTo(half, 6);
    context.lineTo(half, BALL_PX - 6);
    context.moveTo(6, half);
    context.lineTo(BALL_PX - 6, half);
    context.stroke();
  }

  handle(light, selected, size) {
    const [x, y] = placeOf(directionOf(light.azimuth, light.elevation));
    const [px, py] = [((x * 0.97 + 1) / 2) * size, ((1 - y * 0.97) / 2) * size];
    const { context } = this;
    const glow = context.createRadialGradient(px, py, 0, px, py, size * 0.1);
    glow.addColorStop(0, light.colour + "b0");
    glow.addColorStop(1, light.colour + "00");
    context.fillStyle = glow;
    context.fillRect(px - size * 0.1, py - size * 0.1, size * 0.2, size * 0.2);
    context.beginPath();
    context.arc(px, py, size * (selected ? 0.034 : 0.026), 0, 2 * Math.PI);
    context.fillStyle = light.colour;
    context.fill();
    context.lineWidth = size * (selected ? 0.012 : 0.007);
    context.strokeStyle = selected ? "#ff9d2e" : "#101010";
    context.stroke();
  }
}
