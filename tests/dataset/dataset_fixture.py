"""A tiny prepared dataset without its capture: built-in heads by Lambert's law, fits of the true geometry."""

from collections.abc import Collection, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from facerf_cli.dataset.dataset import (
    DATASET_FILE,
    FORMAT,
    SPLITS,
    Dataset,
    DatasetFolder,
    read_dataset,
)
from facerf_cli.dataset.prepare import constant_weights, stack_header
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit, save_fit
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.files.documents import write_document
from facerf_cli.files.image_metadata import Provenance
from facerf_cli.files.olat_stack import write_olat_stack
from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.synth.appearance.skin import draw_skin

YAW_DEG = (-15.0, 20.0, 40.0, -40.0)  # of the head, one a camera: camera k sees it turned so far


def write_small_dataset(
    folder: Path,
    counts: tuple[int, int, int] = (2, 1, 1),
    cameras: int = 2,
    lights: int = 20,
    crop_px: int = 64,
    seed: int = 0,
    lacking: Mapping[str, Collection[int]] | None = None,
) -> Dataset:
    """Write `counts` subjects for training, validation and test, and read the dataset back.

    Every subject has its own shape and skin, and is exactly where its fit says; no shadows. The world is the
    head's own frame. Subjects in `lacking` have stacks without those lights.
    """
    model = load_face_model()
    generator = torch.Generator().manual_seed(seed)
    world = rig_directions(lights)
    subjects = [f"{index:04d}" for index in range(sum(counts))]
    ids = [f"C{index}" for index in range(cameras)]
    turns = [pose_to_rotation(yaw_deg, 0, 0) for yaw_deg in YAW_DEG[:cameras]]
    lacks = {subject: (lacking or {}).get(subject, ()) for subject in subjects}
    kept = {subject: [i for i in range(lights) if i not in lacks[subject]] for subject in subjects}
    for subject in subjects:
        alpha = 0.4 * torch.randn(len(model.identity), generator=generator)
        albedo = draw_skin(1, 128, generator).albedo[0]
        for camera, rotation in zip(ids, turns, strict=True):
            fit = _true_fit(model, alpha, rotation, crop_px)
            _write_one(folder, subject, camera, model, fit, albedo, world[kept[subject]])
    ends = np.cumsum([0, *counts]).tolist()
    parts = zip(SPLITS, pairwise(ends), strict=True)
    content = {
        "format": FORMAT,
        "capture": "small",
        "face_model": model.name,
        "crop_px": crop_px,
        "colour_space": "lin_rec709",
        "axes": "x right, y up, z toward the camera",
        "rig": {
            "lights": [
                {"id": f"L{index:03d}", "direction_world": direction}
                for index, direction in enumerate(world.tolist())
            ]
        },
        "cameras": [{"id": camera} for camera in ids],
        "normalisation": {"from": "lin_rec709", "to": "lin_rec709", "black_level": 0.0},
        "splits": {split: subjects[first:last] for split, (first, last) in parts},
        "subjects": {
            subject: {"status": "done", "traits": {}, "cameras": ids}
            | ({"lights": [f"L{index:03d}" for index in kept[subject]]} if lacks[subject] else {})
            for subject in subjects
        },
        "provenance": {"synthetic": True},
    }
    write_document(folder / DATASET_FILE, content)
    return read_dataset(folder)


def _true_fit(model: MorphableModel, alpha: torch.Tensor, rotation: torch.Tensor, crop_px: int) -> FaceFit:
    crop = Crop(0.0, 0.0, float(crop_px), crop_px)
    translation_m = torch.tensor([0.0, 0.0, -1.0]) - rotation @ torch.tensor([0.0, 0.0, 0.06])
    beta = torch.zeros(len(model.expression))
    vertices = model.vertices(alpha[None], beta[None]) @ rotation.T + translation_m
    landmarks_px = project(model.landmarks(vertices)[0], crop_camera(crop_px))
    return FaceFit(model.name, crop, rotation, translation_m, alpha, beta, landmarks_px, 0.0)


def _write_one(
    folder: Path,
    subject: str,
    camera: str,
    model: MorphableModel,
    fit: FaceFit,
    albedo: torch.Tensor,
    world: torch.Tensor,
) -> None:
    directions = world @ fit.rotation.T  # the world is the head's frame
    fragments = rasterize(fit.vertices_camera(model), grid_triangles(), fit.camera)
    skin = sample_texture(albedo, interpolate(grid_uv(), grid_triangles(), fragments)).permute(2, 0, 1)
    source = np.zeros((*fragments.covered.shape, 3), np.float32)
    header = stack_header(
        model,
        fit,
        directions.numpy(),
        source,
        np.ones(fragments.covered.shape, bool),
        Provenance(f"{subject}/{camera}", **model.stamp).attributes(),
    )
    cosine = torch.einsum("lc,hwc->lhw", directions, torch.from_numpy(header.normals)).clamp(min=0)
    olats = skin * fragments.covered * cosine[:, None]  # [L, 3, H, W]
    weights = torch.from_numpy(constant_weights(directions.numpy()))
    source[:] = torch.einsum("l,lchw->hwc", weights, olats).numpy()
    write_olat_stack(DatasetFolder(folder=folder).stack_path(subject, camera), header, [olats])
    path = DatasetFolder(folder=folder).fit_path(subject, camera)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_fit(path, fit)
