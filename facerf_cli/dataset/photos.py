"""Crops of faces in photos, with detected landmarks; faces are detected once and cached.

The stage `joint` trains on them (`--photos`).
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.batch.recipe import Recipe, key_of
from facerf_cli.dataset.crops import CropMove
from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.files.documents import Document, Points68, read_document, write_document
from facerf_cli.files.read import read_image
from facerf_cli.files.texts import text_of_state
from facerf_cli.files.write import write_display
from facerf_cli.network.batch import Batch
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.run.workers import in_shards

CACHED_SIDE_PX = 512  # the side of the paper's crops
log = logging.getLogger(LOGGER_NAME)


class _PhotoRecord(Document):
    landmarks_px: Points68 | None


@dataclass(frozen=True)
class PhotoCrops(Batch):
    """B crops of photos [B, 3, S, S], scene-linear, and detected landmarks [B, 68, 2] in crop pixels."""

    crops: Tensor
    landmarks_px: Tensor


@dataclass(frozen=True, eq=False)
class Photos:
    """Detected faces, drawn as crops of `side_px`."""

    paths: tuple[Path, ...]  # crops in the cache
    landmarks_px: Tensor  # [N, 68, 2] in crops of `CACHED_SIDE_PX`
    side_px: int

    def draw(self, generator: torch.Generator) -> PhotoCrops:
        """Draw a random face, B = 1, its crop as a detector's box would cut it."""
        place = int(torch.randint(len(self.paths), (), generator=generator))
        crop = torch.from_numpy(read_image(self.paths[place]).pixels).permute(2, 0, 1)[None]
        move = CropMove.draw(generator)
        points = move.points(self.landmarks_px[place] / CACHED_SIDE_PX)
        return PhotoCrops(move.image(crop, self.side_px), self.side_px * points[None])


def open_photos(
    paths: Iterable[Path], cache: Path, networks: Networks, side_px: int, jobs: int = 1
) -> Photos:
    """Open the faces of photos; detect those missing from `cache`, and log photos without a face.

    Raises InputError if no photo has a face.
    """
    records = {path: cache / f"{key_of(_made_from(path, networks))}.json" for path in sorted(paths)}
    missing = [item for item in records.items() if not item[1].is_file()]
    if missing:
        log.info("%s: detecting faces in %d photos (done once)", cache, len(missing))
        work = partial(_detect, networks)
        if jobs > 1 and len(missing) > 1:
            in_shards(work, missing, jobs)
        else:
            work(missing)
    landmarks_px = {
        record.with_suffix(".jpg"): read_document(record, _PhotoRecord, "delete the folder").landmarks_px
        for record in records.values()
    }
    with_face = {path: points for path, points in landmarks_px.items() if points is not None}
    if not with_face:
        raise InputError(
            f"--photos: no face in any of {len(records)} photos; use a folder of photos of faces"
        )
    points_px = torch.from_numpy(np.stack(list(with_face.values()))).float()
    return Photos(tuple(with_face), points_px, side_px)


def _made_from(photo: Path, networks: Networks) -> Recipe:
    """List everything that the crop of a photo's face depends on."""
    return {
        "photo": [str(photo.absolute()), text_of_state(photo)],
        "parsing": networks.sha256("parsing"),
        "side": CACHED_SIDE_PX,
    }


def _detect(networks: Networks, records: list[tuple[Path, Path]]) -> None:
    """Write the crop and the record of each photo."""
    for photo, record in records:
        landmarks_px = None
        try:
            pixels = read_image(photo).pixels
            face = find_faces(networks.people, pixels, str(photo))[0]
            crop = from_landmarks(face.landmarks_px, CACHED_SIDE_PX)
            write_display(record.with_suffix(".jpg"), crop.apply(pixels), "auto")
            landmarks_px = crop.to_crop(face.landmarks_px).round(3).tolist()
        except InputError as error:
            log.warning("%s", error)
        write_document(record, {"photo": str(photo), "landmarks_px": landmarks_px})
