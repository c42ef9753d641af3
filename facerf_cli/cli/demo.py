"""`facerf demo`: a contact sheet of a photo that is installed with facerf, relit."""

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import collect_items
from facerf_cli.cli.help import examples_of
from facerf_cli.cli.options import settings_of
from facerf_cli.cli.relight import plan_relight
from facerf_cli.errors import UsageError
from facerf_cli.files.output_options import OutputOptions
from facerf_cli.light.setups import LightSources
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.relight_options import BackgroundChoice, RelightOptions

_DEMO = Path(__file__).parents[1] / "assets/demo"
_LIGHTS = ("-75,0", "-35,25", "50,20", "0,60")
_TILE_PX, _LABEL_PX = 384, 24
log = logging.getLogger(LOGGER_NAME)


def demo(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Contact sheet to write, .jpg or .png.")
    ] = Path("facerf_demo.jpg"),
) -> None:
    """Relight an included photo under four maps and four single lights, and write a contact sheet.

    This takes about 15 seconds. An existing file is not replaced. The photo shows Eileen
    Collins (NASA, public domain).
    """
    if output.suffix.lower() not in (".jpg", ".png"):
        raise UsageError(f"-o {output}: not an image; use a file that ends in .jpg or .png")
    if output.exists():
        raise UsageError(f"-o {output}: file exists; remove it, or use another name")
    settings, level = settings_of(context), log.level
    photo, maps = _DEMO / "astronaut.jpg", sorted(map(str, _DEMO.glob("maps/*.exr")))
    log.setLevel(logging.WARNING if level == logging.INFO else level)  # hides the photo's long path
    options = RelightOptions(
        photo=PhotoOptions(settings),
        background=BackgroundChoice("envmap"),
        output=OutputOptions(formats=("png",)),
    )
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_relight(options, LightSources(envmap=maps, light=[*_LIGHTS]), Path(folder))
        (item,) = collect_items([str(photo)], Path(folder))
        images = plan.ready(dry_run=False).process(item).outputs
        words = [*(f"--envmap {Path(path).name}" for path in maps), *(f"--light {azel}" for azel in _LIGHTS)]
        _write_sheet(output, [photo, *images], ["the photo", *words])
    log.setLevel(level)
    print(output)
    log.info("your own photo: %s", examples_of("relight")[0])


def _write_sheet(sheet: Path, images: Sequence[Path], words: Sequence[str]) -> None:
    """Write images in three columns, each with its word below."""
    import numpy as np  # --help does without it

    from facerf_cli.files.read import read_image
    from facerf_cli.files.sheets import contact_sheet, labels
    from facerf_cli.files.write import write_display
    from facerf_cli.image.strips import resized

    tiles = [
        np.concatenate(
            [resized(read_image(path).pixels, _TILE_PX, _TILE_PX), labels([word], _TILE_PX, _LABEL_PX)]
        )
        for path, word in zip(images, words, strict=True)
    ]
    write_display(sheet, contact_sheet(np.stack(tiles), columns=3))
