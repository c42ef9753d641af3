"""Colour of relit skin under white light against the photo's own.

    python benchmarks/skin_colour.py [PHOTO ...] [--light LIGHT ...]

Over sure skin that neither PNG clips nor crushes (20 to 245 of 255): the ratio of saturation (CIELAB chroma
over lightness, medians), the same where the photo has the luminance of the relit image in each pixel (by
itself the ratio of a darker image is larger), the shift of hue in degrees, and the spread of hue
(interquartile range) in both. The twin, the rows of white `none`, is the colour that networks leave.
"""

from pathlib import Path

import numpy as np
from _common import arguments, photos, print_header, print_row

import facerf_cli as facerf
from facerf_cli.image.colour import (
    SOFT_VIEW,
    encode_display,
    lab_d65,
    luminance,
    srgb_to_linear,
)
from facerf_cli.person import Person
from facerf_cli.pipeline import reflectance_of

LIGHTS = {
    "45,20": facerf.Light.single(45, 20),
    "-75,10": facerf.Light.single(-75, 10),
    "0,70": facerf.Light.single(0, 70),
    "around": facerf.Light.around(),
}
ROOM = 0.06  # the share that `relight` adds to single lights
DARK, BRIGHT = 20, 245  # of 255
SURE = 0.9  # share of skin


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--light", action="append", choices=sorted(LIGHTS), help="may be repeated")
    given, models = parser.parse_args(), facerf.load_models()
    print_header("photo", "light", "white", "saturation", "at its luminance", "hue", "spread", "photo's")
    for path in photos(given.photos):
        photo = facerf.read_image(path)
        person = facerf.fit(models, photo)
        plain = reflectance_of(models, person.head, "portrait", photo=photo)
        twin = Person(models, photo, person.head, plain)
        for light in given.light or LIGHTS:
            for white, one in (("photo", person), ("none", twin)):
                image = one.relight(LIGHTS[light], room=0.0 if light == "around" else ROOM)
                row = figures(image, photo, person.classes["skin"])
                print_row(path.stem, light, white, *(f"{value:.2f}" for value in row))


def figures(image: np.ndarray, photo: np.ndarray, skin: np.ndarray) -> tuple[float, ...]:
    """The figures of a relit image and a photo, scene-linear [H, W, 3], over the skin [H, W]."""
    means = [float(luminance(one)[skin > SURE].mean()) for one in (photo, image)]
    exposed = image * np.float32(means[0] / means[1])  # skin as bright as in the photo
    shown, plate = (np.round(255 * encode_display(one, SOFT_VIEW)) for one in (exposed, photo))
    sure = skin > SURE
    for one in (shown, plate):
        sure = sure & (one.min(-1) > DARK) & (one.max(-1) < BRIGHT)
    relit, before = (srgb_to_linear(one[sure].astype(np.float32) / 255) for one in (shown, plate))
    as_bright = before * (luminance(relit) / luminance(before))[:, None]
    found, own, dimmed = (colour(one) for one in (relit, before, as_bright))
    return found[0] / own[0], found[0] / dimmed[0], found[1] - own[1], found[2], own[2]


def colour(linear: np.ndarray) -> tuple[float, float, float]:
    """Median saturation and hue of colours [N, 3], and the spread of hue, both in degrees."""
    lightness, a, b = lab_d65(linear).T
    hue = np.degrees(np.arctan2(b, a))
    low, high = np.percentile(hue, (25, 75))
    return float(np.median(np.hypot(a, b) / lightness)), float(np.median(hue)), float(high - low)


if __name__ == "__main__":
    main()
