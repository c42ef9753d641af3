#!/usr/bin/env python
"""The paper's figures: single lights at other head poses, and the light of one photo on another face.

    python examples/paper/figures.py OUT CHECKPOINT PHOTO...

OUT/olat-PHOTO.png has a row for each pose and a column for each light, the photo on its left.
OUT/transfer.png has the photos, and below them a row for each face: it is relit by the light of the photo
above. All images are of the network alone, in the crop of the photo. A photo in which no face is found is
left out.
"""

import sys
from pathlib import Path

import numpy as np

import facerf_cli as facerf
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop

POSES_DEG = ((0.0, 0.0, 0.0), (-30.0, 0.0, 0.0), (30.0, 0.0, 0.0), (0.0, -15.0, 0.0))
LIGHTS_DEG = ((-80, 0), (-40, 20), (0, 0), (0, 60), (40, 20), (80, 0))
CELL_PX = 192


def cell(image: np.ndarray) -> np.ndarray:
    """A square image [S, S, 3] at the size of a cell."""
    return Crop(0.0, 0.0, float(image.shape[0]), CELL_PX).apply(image)


def relit(
    person: facerf.Person, lights: list[facerf.Light], pose: tuple[float, float, float] | None = None
) -> list[np.ndarray]:
    """Cells of the face alone under each light, on black."""
    images = person.relight(lights, pose, alone=True)
    crop = person.head.fit.crop
    return [cell(crop.apply(image[..., :3] * image[..., 3:])) for image in images]


def olat_grid(person: facerf.Person) -> np.ndarray:
    """A row for each pose, a column for each light."""
    lights = [facerf.Light.single(*angles) for angles in LIGHTS_DEG]
    left = [cell(person.head.cropped), *[np.zeros((CELL_PX, CELL_PX, 3), np.float32)] * len(POSES_DEG)]
    return tiled(
        [[first, *relit(person, lights, pose)] for first, pose in zip(left, POSES_DEG, strict=False)]
    )


def transfer(people: list[facerf.Person]) -> np.ndarray:
    """The photos, and each face under the light of each photo."""
    lights = [person.light for person in people]
    return tiled([[cell(person.head.cropped) for person in people], *(relit(p, lights) for p in people)])


def tiled(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Rows of cells as one image."""
    return np.concatenate([np.concatenate(row, 1) for row in rows])


def main(out: Path, checkpoint: Path, *photos: Path) -> None:
    """Write the figures of photos."""
    models, people = facerf.load_models(checkpoint), []
    out.mkdir(parents=True, exist_ok=True)
    for path in photos:
        try:
            photo = facerf.read_image(path)
            people.append(facerf.fit(models, photo, reflectance="field", network_alone=True))
        except InputError as error:
            print(f"{path}: left out ({error})", file=sys.stderr)
            continue
        facerf.write_image(out / f"olat-{path.stem}.png", olat_grid(people[-1]))
    if people:
        facerf.write_image(out / "transfer.png", transfer(people))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
