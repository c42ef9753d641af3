"""What `prepare-dataset` writes of a dataset as a whole: `dataset.json`, and the key that one run goes by."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from facerf_cli import __version__
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.stage.data.capture import Capture
from facerf_cli.stage.data.dataset import FORMAT, SPLITS
from facerf_cli.stage.data.documents import digest
from facerf_cli.stage.data.splits import Split

_COLOUR_SPACE = "lin_rec709"


def preparation_key(capture: Capture, face_model_sha256: str, crop_px: int) -> str:
    """What a subject's files depend on besides its pictures, as a short digest."""
    content = [FORMAT, capture.pattern, face_model_sha256, crop_px, _calibration(capture)]
    return digest(json.dumps(content, sort_keys=True).encode())


def describe_dataset(
    capture: Capture,
    records: Mapping[str, Mapping[str, Any]],
    split: Split,
    seed: int,
    model: MorphableModel,
    face_model_sha256: str,
    crop_px: int,
) -> dict[str, Any]:
    """The content of `dataset.json`; subjects without a record are those that failed."""
    splits = split.of(capture.subjects, seed)
    return {
        "format": FORMAT,
        "capture": capture.folder.resolve().name,
        "face_model": model.name,
        "crop_px": crop_px,
        "colour_space": _COLOUR_SPACE,
        "axes": "x right, y up, z toward the camera; metres; pixel centres at index + 0.5",
        **_calibration(capture),
        "splits": {name: [subject for subject in splits[name] if subject in records] for name in SPLITS},
        "subjects": {
            subject: {"traits": traits, **_status(records.get(subject))}
            for subject, traits in capture.subjects.items()
        },
        "provenance": {
            "software": f"facerf {__version__}",
            "face_model_licence": model.licence,
            "face_model_sha256": face_model_sha256,
            "split_seed": seed,
            "capture": capture.provenance,
        },
    }


def _status(record: Mapping[str, Any] | None) -> dict[str, Any]:
    if record is None:
        return {"status": "failed"}
    known = {name: record[name] for name in ("error_iod", "quality", "faces_found")}
    less = {
        name: record[name] for name in ("lights", "left_out", "dropped", "ambient_kept") if name in record
    }
    return {"status": "done", **known, "cameras": list(record["cameras"]), **less}


def _calibration(capture: Capture) -> dict[str, Any]:
    """Lights, cameras and what was done to the pictures' values."""
    lights = zip(capture.light_ids, capture.directions_world.tolist(), strict=True)
    gains = zip(capture.light_ids, (1 / capture.intensities).tolist(), strict=True)
    return {
        "rig": {"lights": [{"id": name, "direction_world": direction} for name, direction in lights]},
        "cameras": [
            {
                "id": name,
                "width": posed.width_px,
                "height": posed.height_px,
                "focal_px": posed.focal_px,
                "centre_px": posed.centre_px,
                "world_to_camera": torch.cat([posed.rotation, posed.translation_m[:, None]], 1).tolist(),
            }
            for name, posed in capture.cameras.items()
        ],
        "normalisation": {
            "from": capture.colour_space,
            "to": _COLOUR_SPACE,
            "black_level": capture.black_level,
            **({"ambient": "subtracted where there is a picture of it"} if capture.subtract_ambient else {}),
            **({"head_motion": "frames shifted back, by fits/SUBJECT.json"} if capture.align else {}),
            "gain": dict(gains),
            **({"colour_charts": [chart.record() for chart in capture.charts]} if capture.charts else {}),
            "non_finite": "set to 0",
            "negative": "set to 0 after the crop",
        },
    }


def sha256_of(path: Path) -> str:
    """The digest of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
