"""What `facerf relight` makes of photos under single lights in a room: grain, voids, fog, least values.

    python benchmarks/single_lights.py [PHOTO ...] [--light AZ,EL ...] [--keep DIR]

Grain: local contrast of the relit person over that of the photo (standard deviation of log luminance
without what is coarser than 3 pixels, in blocks of 16 x 16 pixels that are black in neither): its
median, and the share of blocks that keep less than half. Voids: the share of the person's pixels that
are below 6 of 255, and above 16 in the photo. Least: the smallest value of the person in the EXR. Fog:
the median of cloth, and of hair, over that of the brighter half of the skin, divided by the same ratio
in the photo (1: as in the photo); its mean, and its largest value. The room is the default one; the twin
is the photo under a map.
"""

import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from _common import ROOT, arguments, photos
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

from facerf_cli.files.read import read_image
from facerf_cli.image.colour import luminance
from facerf_cli.main import app

BLOCK, COARSE_PX, FLOOR = 16, 3.0, 0.002
VOID, SEEN = 6, 16  # of 255
SURE, LEAST_SHARE = 0.9, 0.05  # of a class in a pixel; of its pixels over those of skin
LIGHTS = ("45,20", "-75,10", "160,10")
MAP = ROOT / "examples" / "maps" / "low_sun.exr"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--light", action="append", help="may be repeated; by default " + " ".join(LIGHTS))
    parser.add_argument("--keep", type=Path, help="folder for the images")
    given = parser.parse_args()
    print("| light | median grain | blocks below half | voids | least | fog of cloth | of hair |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for light in (*(given.light or LIGHTS), MAP.stem):
            rows = [row_of(path, light, given.keep or Path(folder)) for path in photos(given.photos)]
            means, most = np.nanmean(rows, 0), np.nanmax(rows, 0)
            fog = (f"{means[at]:.2f}, {most[at]:.2f}" for at in (4, 5))
            least = f"{np.min(rows, 0)[3]:.4f}"
            print("|", " | ".join([light, *(f"{mean:.3f}" for mean in means[:3]), least, *fog]), "|")


def row_of(path: Path, light: str, folder: Path) -> tuple[float, ...]:
    """Median of grain, share below half, share of voids, least value, and fog of cloth and of hair."""
    source = ["--envmap", str(MAP)] if light == MAP.stem else ["--light", light]
    command = ["relight", str(path), *source, "-o", str(folder), "--overwrite", "always"]
    result = CliRunner().invoke(app, [*command, "--format", "exr,png", "--aov", "classes"])
    if result.exit_code:
        raise SystemExit(f"{' '.join(command)}: {result.output}")
    exr = next(Path(line) for line in result.output.splitlines() if line.endswith(".exr"))
    matte = oiio.ImageBuf(str(exr), 1, 0).get_pixels()[..., 0]
    classes = oiio.ImageBuf(str(exr), 2, 0)
    shares = np.moveaxis(np.asarray(classes.get_pixels()), -1, 0)
    relit, photo = (read_image(one).pixels for one in (exr.with_suffix(".png"), path))
    median, below = grain(luminance(relit), luminance(photo), matte > 0.97)
    person, shown = matte > 0.9, [255 * image.max(-1).clip(0, 1) ** (1 / 2.2) for image in (relit, photo)]
    voids = ((shown[0] < VOID) & (shown[1] > SEEN))[person].mean()
    linear = read_image(exr).pixels
    share = dict(zip(classes.spec().channelnames, shares, strict=True))
    fogs = (fog(luminance(linear), luminance(photo), share, name) for name in ("garment", "hair"))
    return median, below, float(voids), float(linear[matte > 0].min()), *fogs


def fog(relit: np.ndarray, photo: np.ndarray, share: dict[str, np.ndarray], name: str) -> float:
    """Luminance of a class over that of lit skin, relit over that in the photo [H, W]; NaN where none is."""
    inside, skin = share[f"class.{name}"] > SURE, share["class.skin"] > SURE
    if inside.sum() < LEAST_SHARE * skin.sum():
        return float("nan")
    of_relit, of_photo = (
        np.median(image[inside]) / np.quantile(image[skin], 0.75) for image in (relit, photo)
    )
    return float(of_relit / of_photo)


def grain(relit: np.ndarray, photo: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """Median of the ratio of local contrasts of luminances [H, W], and the share of blocks below a half."""
    fine = [in_blocks(finer(np.log(image.clip(min=0) + FLOOR))).std(1) for image in (relit, photo)]
    light = [in_blocks(image).mean(1) for image in (relit, photo)]
    used = in_blocks(inside).all(1) & (light[0] > 0.004) & (light[1] > 0.01)
    ratio = fine[0][used] / np.maximum(fine[1][used], 1e-4)
    return float(np.median(ratio)), float((ratio < 0.5).mean())


def finer(image: np.ndarray) -> np.ndarray:
    return np.asarray(image - gaussian_filter(image, COARSE_PX))


def in_blocks(image: np.ndarray) -> np.ndarray:
    """Values [N, BLOCK * BLOCK] of the whole blocks of an image [H, W]."""
    height, width = (side // BLOCK * BLOCK for side in image.shape)
    blocks = image[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    return blocks.swapaxes(1, 2).reshape(-1, BLOCK * BLOCK)


if __name__ == "__main__":
    main()
