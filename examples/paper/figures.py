#!/usr/bin/env python
"""The paper's figures of photos: single lights at other head poses, and the light of one photo on another face.

    python examples/paper/figures.py OUT CHECKPOINT PHOTO...

OUT/olat-PHOTO.png has a row for each pose and a column for each light, the photo on its left. OUT/transfer.png
has the photos, and below them a row for each face: it is relit by the light of the photo above. All images are
of the network alone, in the crop of the photo. A photo in which no face is found is left out.
"""

import sys
from pathlib import Path

import numpy as np

import facerf_cli as facerf
from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop

POSES_DEG = ((0, 0, 0), (-30, 0, 0), (30, 0, 0), (0, -15, 0))
LIGHTS_DEG = ((-80, 0), (-40, 20), (0, 0), (0, 60), (40, 20), (80, 0))
CELL_PX = 192


class Figures:
    """Images of photos by one checkpoint's networks, in cells [CELL_PX, CELL_PX, 3] on black."""

    def __init__(self, checkpoint: Path, photos: list[Path]) -> None:
        self.models = facerf.load_models(checkpoint)
        self.faces = {}
        for path in photos:
            photo = facerf.read_image(path)
            try:
                self.faces[path.stem] = photo, facerf.fit_photo(self.models, photo)
            except InputError as error:
                print(f"{path}: left out ({error})", file=sys.stderr)

    def cropped(self, name: str) -> np.ndarray:
        """The photo in its crop."""
        head = self.faces[name][1]
        return _cell(head.cropped)

    def relit(self, name: str, light: facerf.Light, pose: tuple[int, int, int] | None = None) -> np.ndarray:
        """The face alone under a light."""
        photo, head = self.faces[name]
        made = facerf.relight(
            self.models, photo, head, light, pose, alone=True, reflectance="field", network_alone=True
        )
        return _cell(head.fit.crop.apply(made[..., :3] * made[..., 3:]))

    def olats(self, name: str) -> np.ndarray:
        """A row for each pose, a column for each light."""
        lights = [facerf.Light.single(*angles) for angles in LIGHTS_DEG]
        rows = [[self.relit(name, light, pose) for light in lights] for pose in POSES_DEG]
        left = [self.cropped(name), *[np.zeros((CELL_PX, CELL_PX, 3), np.float32)] * (len(rows) - 1)]
        return _tiled([[first, *row] for first, row in zip(left, rows, strict=True)])

    def transfer(self) -> np.ndarray:
        """The photos, and each face under the light of each photo."""
        lights = {name: facerf.estimate_light(self.models, head) for name, (_, head) in self.faces.items()}
        rows = [[self.relit(name, light) for light in lights.values()] for name in self.faces]
        return _tiled([[self.cropped(name) for name in self.faces], *rows])


def _cell(image: np.ndarray) -> np.ndarray:
    return Crop(0.0, 0.0, float(image.shape[0]), CELL_PX).apply(image)


def _tiled(rows: list[list[np.ndarray]]) -> np.ndarray:
    return np.concatenate([np.concatenate(row, 1) for row in rows])


def main(out: Path, checkpoint: Path, *photos: Path) -> None:
    """Write the figures of photos."""
    figures = Figures(checkpoint, list(photos))
    out.mkdir(parents=True, exist_ok=True)
    for name in figures.faces:
        facerf.write_image(out / f"olat-{name}.png", figures.olats(name))
    if figures.faces:
        facerf.write_image(out / "transfer.png", figures.transfer())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
