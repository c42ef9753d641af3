"""Dragging a light over a page of `facerf view`: milliseconds a frame, texture fetches and bytes.

    python benchmarks/page_dragging.py [PHOTO ...] [--steps 30]

The mouse is moved over the face in headless Chromium, at 1280 x 800; WebGL2 is drawn by software, and its
work is awaited. The medians are of the time to compute the light of all pixels, to send it to the GPU, to
draw, and of the whole frame with the panel.
"""

import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path

from _common import ASTRONAUT, arguments, print_header, print_row
from _devtools import LivePage

from facerf_cli.main import main as facerf

WIDTH, HEIGHT = 1280, 800
FETCHES, IN_FACE = 11, 4  # of a pixel, and more in the face's window (viewer/gpu.js)
_WATCH = """
(() => {
  const watched = {
    light: [LightField, "under"], send: [GpuView, "light"], draw: [GpuView, "draw"], frame: [Page, "frame"],
  };
  window.seen = { light: [], send: [], draw: [], frame: [], bytes: [] };
  let bytes = 0;
  for (const name of ["texImage2D", "texSubImage3D"]) {
    const own = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      bytes += given.at(-1)?.byteLength ?? 0;
      return own.apply(this, given);
    };
  }
  for (const [name, [kind, method]] of Object.entries(watched)) {
    const own = kind.prototype[method];
    kind.prototype[method] = function (...given) {
      const begun = performance.now();
      const result = own.apply(this, given);
      const pixel = new Uint8Array(4); // reading one waits for all work of the GPU
      if (name === "draw") this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, pixel);
      seen[name].push(performance.now() - begun);
      if (name === "frame") seen.bytes.push(bytes);
      if (name === "frame") bytes = 0;
      return result;
    };
  }
})()
"""
_NEXT = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
_FACTS = """(() => {
  const data = JSON.parse(byId("data").textContent);
  const box = byId("view").getBoundingClientRect();
  const median = (values) => values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];
  return { size: data.size, window: data.window, box: [box.x, box.y, box.width, box.height],
    frames: seen.frame.length, ...Object.fromEntries(Object.entries(seen).map(([k, v]) => [k, median(v)])) };
})()"""


def measure(page: Path, steps: int) -> None:
    """Print the row of a page."""
    with LivePage(page, WIDTH, HEIGHT) as live:
        live.settle()
        live.run(_WATCH)
        x, y, width, height = live.run(_FACTS)["box"]
        live.pointer("mousePressed", x + 0.4 * width, y + 0.3 * height)
        for step in range(steps):
            live.pointer("mouseMoved", x + (0.4 + 0.3 * step / steps) * width, y + 0.3 * height)
            live.run(_NEXT)
        live.pointer("mouseReleased", x + 0.7 * width, y + 0.3 * height)
        found = live.run(_FACTS)
    pixels, inside = found["size"][0] * found["size"][1], found["window"][2] * found["window"][3]
    fetches = FETCHES * pixels + IN_FACE * inside
    times = [f"{found[name]:.0f}" for name in ("light", "send", "draw", "frame")]
    sizes = [f"{fetches / 1e6:.1f}", f"{found['bytes'] / 2**20:.1f}"]
    print_row(page.stem, "{} x {}".format(*found["size"]), found["frames"], *times, *sizes)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path, default=[ASTRONAUT])
    parser.add_argument("--steps", type=int, default=30)
    given = parser.parse_args()
    times = ("light, ms", "sending, ms", "drawing, ms", "frame, ms")
    print_header("page", "photo", "frames", *times, "million fetches", "MiB sent")
    for photo in given.photos:
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / f"{photo.stem}.html"
            with redirect_stdout(sys.stderr):
                code = facerf(["view", str(photo), "-o", str(page)])
            if code:
                raise SystemExit(f"{photo}: no page was made")
            measure(page, given.steps)


if __name__ == "__main__":
    main()
