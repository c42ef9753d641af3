"""Photos of faces, with detected landmarks alone, for the landmark and regularisation terms.

The paper uses images of FFHQ ('Training'). Faces are detected once:

    CACHE/KEY.jpg    crop of the largest face at automatic exposure
    CACHE/KEY.json   its landmarks in crop pixels, or null where there is no face; written last

KEY is a digest of the photo's path, size and time. The cache may be deleted.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.dataset.crop_move import CropMove
from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.files.documents import Document, Points68, digest, read_document, write_document
from facerf_cli.files.images import read_image, write_display
from facerf_cli.logs import LOGGER_NAME
from facerf_cli.portrait.find import find_faces
from facerf_cli.workers import in_shards

CACHED_SIDE_PX = 512  # the side of the paper's crops
log = logging.getLogger(LOGGER_NAME)


class _PhotoRecord(Document):
    landmarks_px: Points68 | None


@dataclass(frozen=True)
class PhotoCrops:
    """B crops of photos [B, 3, S, S], scene-linear, and detected landmarks [B, 68, 2] in crop pixels."""

    crops: Tensor
    landmarks_px: Tensor

    def to(self, device: torch.device) -> "PhotoCrops":
        """Copy the crops to `device`."""
        return PhotoCrops(*(getattr(self, field.name).to(device) for field in fields(self)))


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


def open_photos(paths: Iterable[Path], cache: Path, side_px: int, jobs: int = 1) -> Photos:
    """Open the faces of photos; detect those that are not in `cache`, with a warning for a photo without one.

    Raises InputError where no photo has a face.
    """
    known = {path: _record_path(path, cache) for path in sorted(paths)}
    missing = [path for path, record in known.items() if not record.is_file()]
    if missing:
        log.info("%s: detecting faces in %d photos (done once)", cache, len(missing))
        work = partial(_detect, cache)
        if jobs > 1 and len(missing) > 1:
            in_shards(work, missing, jobs)
        else:
            work(missing)
    found, landmarks = [], []
    for record in known.values():
        landmarks_px = read_document(record, _PhotoRecord, "delete the folder").landmarks_px
        if landmarks_px is not None:
            found.append(record.with_suffix(".jpg"))
            landmarks.append(landmarks_px)
    if not found:
        raise InputError(f"--photos: no face in any of {len(known)} photos; give a folder of photos of faces")
    return Photos(tuple(found), torch.from_numpy(np.stack(landmarks)).float(), side_px)


def _record_path(photo: Path, cache: Path) -> Path:
    facts = photo.stat()
    return cache / f"{digest(f'{photo.absolute()} {facts.st_size} {facts.st_mtime_ns}'.encode())}.json"


def _detect(cache: Path, photos: list[Path]) -> None:
    """Write the crop and the record of each photo."""
    cache.mkdir(parents=True, exist_ok=True)
    for photo in photos:
        record = _record_path(photo, cache)
        landmarks_px = None
        try:
            pixels = read_image(photo).pixels
            face = find_faces(pixels, str(photo))[0]
            crop = from_landmarks(face.landmarks_px, CACHED_SIDE_PX)
            write_display(record.with_suffix(".jpg"), crop.apply(pixels), "auto")
            landmarks_px = crop.to_crop(face.landmarks_px).round(3).tolist()
        except InputError as error:
            log.warning("%s", error)
        write_document(record, {"photo": str(photo), "landmarks_px": landmarks_px})
