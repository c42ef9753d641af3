"""Draw the pictures of docs/tutorial.md, each by the command above it.

    python examples/tutorial.py [FOLDER]

The picture of the page of `facerf view` needs Chromium.
"""

import contextlib
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from facerf_cli.main import main

ROOT = Path(__file__).parents[1]
SIDE_PX, GREY = 360, (128, 128, 128)
_WAIT = """<script>
  const waiting = setInterval(() => document.body.dataset.settled === "true" && clearInterval(waiting), 20);
</script></body>"""  # without a timer the browser's clock runs out before the first image
_STEP = re.compile(r"```sh\n([^`]*?)\n```\n\n!\[[^\n]*\]\(pictures/(\w+\.jpg)\)")


def step(command: str, folder: Path) -> Image.Image:
    """The picture of what a command makes in a folder."""
    *words, output = shlex.split(command)
    made = folder / output
    if main(["-q", *words[1:], str(made)]):
        raise SystemExit(1)
    if made.is_dir():
        (stack,) = made.glob("*.exr")
        return Image.fromarray((127.5 + 127.5 * layer(stack, "normal")).astype("uint8"))
    if made.suffix == ".html":
        made = screenshot(made)
    image = Image.open(made).convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", image.size, (*GREY, 255)), image).convert("RGB")


def layer(stack: Path, name: str) -> np.ndarray:
    """A layer [H, W, 3] of an EXR."""
    part, image = 0, oiio.ImageBuf(str(stack))
    while image.spec().get_string_attribute("name") != name:
        image = oiio.ImageBuf(str(stack), part := part + 1, 0)
    return np.asarray(image.get_pixels(oiio.FLOAT))


def screenshot(page: Path) -> Path:
    """A PNG of a page, by Chromium."""
    target = page.with_suffix(".png")
    source = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text(), flags=re.S)
    page.write_text(source.replace("</body>", _WAIT))
    words = ["chromium", "--headless", "--no-sandbox", "--enable-unsafe-swiftshader"]
    words += ["--window-size=1100,900", "--virtual-time-budget=1000000000", f"--screenshot={target}"]
    words += [f"--user-data-dir={page.parent / 'profile'}", f"{page.as_uri()}#light=key=60,25"]
    subprocess.run(words, check=True, capture_output=True)
    return target


if __name__ == "__main__":
    target = Path(sys.argv[1] if sys.argv[1:] else ROOT / "docs/pictures").resolve()
    pictures = {"tutorial_photo.jpg": Image.open(ROOT / "examples/astronaut.jpg").convert("RGB")}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(ROOT):
        for command, name in _STEP.findall((ROOT / "docs/tutorial.md").read_text()):
            pictures[name] = step(command, Path(folder))
    for name, picture in pictures.items():
        small = picture.resize((SIDE_PX * picture.width // picture.height, SIDE_PX), Image.Resampling.LANCZOS)
        small.save(target / name, quality=85)
