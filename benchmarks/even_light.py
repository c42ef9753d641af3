"""Shadows and glare of a photo's light that stay in even light: synthetic people in hard light.

    facerf synth-stage --subjects 8 --size 384 --cameras 1 --frame bust --lights 48 --seed 5 -o CAPTURE
    python benchmarks/even_light.py CAPTURE

A source is one hard light and a dim fill; the truth is the capture in even light. Printed, in percent:

    band    luminance of the shade under the chin over that of the cheeks, less that of the truth
    glare   luminance of the glare on the forehead over that of the rest of it, likewise
    skin    root mean square difference of log luminance over all skin, whose mean is that of the truth

of band and glare the mean, and the mean size. The twin is the photo left as it is.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from _common import arguments, print_header, print_row, required

import facerf_cli as facerf
from facerf_cli.api import Person
from facerf_cli.capture.layouts import read_capture
from facerf_cli.errors import FacerfError
from facerf_cli.image.colour import luminance
from facerf_cli.light.sphere import azel_to_direction

LIGHTS = {
    "flash": (9.0, 8.0),
    "above": (10.0, 39.0),
    "aside": (-42.0, 44.0),
}  # azimuth and elevation, degrees
FILL = 0.06  # of even light
BRIGHT = 0.8  # luminance of the photo that a fiftieth of the skin exceeds
SHADE, GLARE = 0.2, 0.9  # irradiance over the cheeks'; share of the forehead that glares less
STRONG = 1.2  # glare over the rest of the forehead, from which on it counts
LEAST_PX, MOST_BEARD = 60, 0.4
BARE = ("skin", "neck", "ears")


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__)
    parser.add_argument("capture", type=Path, nargs="?", help="folder of a synthetic light stage")
    folder, models = (
        required(parser.parse_args().capture, "a synthetic capture", "CAPTURE"),
        facerf.load_models(),
    )
    found: dict[tuple[str, str], list[list[float]]] = {}
    for name, photo, key, truth in photos(folder):
        try:
            person = facerf.fit(models, photo)
        except FacerfError as error:
            print(f"{name}: {error}")
            continue
        for what, image in {"photo": photo, "even": person.relight(person.even)}.items():
            found.setdefault((name, what), []).append(figures(person, image, key, truth))
    print_header("light", "image", "people", "band", "its size", "glare", "its size", "skin")
    for (name, what), rows in found.items():
        band, glare, skin = (100 * np.array(column) for column in zip(*rows, strict=True))
        sizes = [f"{value:.0f}" for one in (band, glare) for value in (np.nanmean(one), np.nanmean(abs(one)))]
        print_row(name, what, len(rows), *sizes, f"{skin.mean():.1f}")


def photos(folder: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Name of the light, photo, its hard light alone and the truth [H, W, 3] of each person and light."""
    capture = read_capture(folder)
    camera = next(iter(capture.cameras))
    toward = capture.directions_world @ capture.cameras[camera].rotation.numpy().T
    for subject, traits in capture.subjects.items():
        if traits["headwear"] != "none" or traits["beard"] > MOST_BEARD:
            continue  # in its shade all of the face may lie
        frames = np.stack([capture.frame(subject, camera, light) for light in range(len(toward))])
        truth = frames.mean(0) * 4  # from=around: all sends what one light sends that a surface faces
        for name, at in LIGHTS.items():
            key = frames[(toward @ azel_to_direction(*at).numpy()).argmax()]
            photo = key + FILL * truth
            shown = luminance(photo)[truth.max(-1) > 0]
            yield name, (photo * (BRIGHT / np.percentile(shown, 98))).clip(0, 1), key, truth


def figures(person: Person, image: np.ndarray, key: np.ndarray, truth: np.ndarray) -> list[float]:
    """Band, glare and skin of an image [H, W, 3]; NaN of what is not there."""
    bare = sum(person.classes[name] for name in BARE) > 0.95
    bare &= luminance(truth) > 0
    shown, lit = luminance(image), luminance(key) / luminance(truth).clip(1e-6)
    wanted, marks = luminance(truth), person.landmarks
    y, x = np.indices(bare.shape) + 0.5
    face = np.ptp(marks, 0).max()
    cheeks = np.zeros_like(bare)
    for of in ((2, 31, 41), (14, 35, 46)):
        cheeks |= np.hypot(x - marks[list(of), 0].mean(), y - marks[list(of), 1].mean()) < 0.1 * face
    cheeks &= bare
    cheeks &= lit > 0.5 * np.median(lit[cheeks])
    below = (y > marks[57, 1]) & (y < marks[8, 1] + 0.4 * face)
    band = bare & below & (lit < SHADE * np.median(lit[cheeks]))
    brows = marks[17:27, 1].min()
    forehead = bare & (y < brows) & (x > marks[17, 0]) & (x < marks[26, 0])
    glare = forehead & (lit > np.quantile(lit[forehead], GLARE)) if forehead.any() else forehead
    rest = forehead & ~glare
    strong = glare.any() and lit[glare].mean() > STRONG * np.median(lit[rest])

    def beyond(one: np.ndarray, other: np.ndarray, is_there: bool) -> float:
        if not is_there or min(one.sum(), other.sum()) < LEAST_PX:
            return float("nan")
        ratios = [values[one].mean() / values[other].mean() for values in (shown, wanted)]
        return float(ratios[0] / ratios[1] - 1)

    change = np.log(shown[bare].clip(1e-4) / wanted[bare].clip(1e-4))
    return [beyond(band, cheeks, True), beyond(glare, rest, strong), float(change.std())]


if __name__ == "__main__":
    main()
