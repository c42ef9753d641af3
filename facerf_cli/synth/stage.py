"""Synthetic light stage: random subjects, photographed by every camera under every light into a capture."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli._version import __version__
from facerf_cli.capture.stage_json import STAGE_FILE, STAGE_FORMAT
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import write_document
from facerf_cli.files.image_metadata import COMPUTER_GRAPHICS_SOURCE_TYPE, Provenance
from facerf_cli.files.texts import read_json
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.renderer import bake_light, images_under, view_of
from facerf_cli.synth.stage_settings import StageSettings
from facerf_cli.synth.views import StageCamera, stage_cameras

_BAKE = BakeSettings()


def light_directions(settings: StageSettings) -> np.ndarray:
    """Unit directions [L, 3] toward the lights, world space."""
    return rig_directions(settings.lights).numpy().astype(np.float64)


def _cameras(settings: StageSettings) -> tuple[StageCamera, ...]:
    return stage_cameras(settings.size_px, settings.frame)[: settings.cameras]


def describe_stage(settings: StageSettings) -> dict[str, Any]:
    """Build the content of stage.json, without subjects."""
    flip = np.diag([1.0, -1.0, -1.0])  # to OpenCV axes
    cameras = []
    for index, view in enumerate(_cameras(settings)):
        pose = np.column_stack([view.head_to_camera.double().numpy(), view.translation_m.double().numpy()])
        focal, centre = view.camera.focal_px, view.camera.cx_px
        cameras.append(
            {
                "id": f"C{index}",
                "width": settings.size_px,
                "height": settings.size_px,
                "K": [[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]],
                "world_to_camera": (flip @ pose).tolist(),
            }
        )
    model = cached_face_model(settings.face_model)
    return {
        "format": STAGE_FORMAT,
        "colour_space": "lin_rec709",
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": "{subject}/{camera}/{light}.exr",
        "lights": [
            {"id": f"L{index:03d}", "direction": direction, "intensity": [1.0, 1.0, 1.0]}
            for index, direction in enumerate(light_directions(settings).tolist())
        ],
        "cameras": cameras,
        "provenance": {
            "software": f"facerf {__version__}",
            "synthetic": True,
            **model.stamp,
            "skin": "procedural (facerf)",
            "settings": asdict(replace(settings, face_model=model.name)),
        },
    }


def open_capture(folder: Path, settings: StageSettings) -> None:
    """Write stage.json; raise UsageError if one with other settings exists."""
    path, described = folder / STAGE_FILE, describe_stage(settings)
    if path.exists():
        try:
            stored = read_json(path, "")
        except InputError:
            stored = {}
        if not isinstance(stored, dict) or {**stored, "subjects": None} != {**described, "subjects": None}:
            raise UsageError(f"{path}: the capture has other settings; use another -o or remove it")
        return
    write_document(path, described)


def close_capture(folder: Path, settings: StageSettings) -> None:
    """Write the traits of all finished subjects to stage.json."""
    records = {path.parent.name: path for path in sorted(folder.glob("*/subject.json"))}
    subjects = {name: read_json(path, "")["traits"] for name, path in records.items()}
    write_document(folder / STAGE_FILE, describe_stage(settings) | {"subjects": subjects})


def photograph_subject(subject: SyntheticPerson, settings: StageSettings) -> Iterator[Tensor]:
    """Render linear images [L, 3, H, W], one camera at a time."""
    cameras = _cameras(settings)
    light = bake_light(subject, cameras, light_directions(settings), _BAKE, settings.seed)
    single = torch.eye(settings.lights)[..., None].expand(-1, -1, 3)
    for camera in cameras:
        yield images_under(*view_of(subject, light, camera), single)


def write_subject(folder: Path, subject: SyntheticPerson, settings: StageSettings) -> None:
    """Write `folder`/CAMERA/LIGHT.exr and subject.json atomically."""
    model = cached_face_model(settings.face_model)
    metadata = Provenance(**model.stamp, source_type=COMPUTER_GRAPHICS_SOURCE_TYPE).attributes()
    with atomic_path(folder) as unfinished:
        for camera, images in enumerate(photograph_subject(subject, settings)):
            for light, image in enumerate(images.permute(0, 2, 3, 1).numpy()):
                write_exr(unfinished / f"C{camera}" / f"L{light:03d}.exr", image, metadata=metadata)
        record = {
            "traits": subject.traits,
            "head_to_world": subject.head_to_world.tolist(),
            "landmarks_world": subject.landmarks_world.tolist(),
            "more_landmarks_world": subject.more_landmarks_world,
        }
        write_document(unfinished / "subject.json", record)
