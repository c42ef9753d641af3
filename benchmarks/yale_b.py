"""Relight the real faces of Extended Yale B to its real point lights, and score that.

    python benchmarks/yale_b.py [--data ../shared/data/extended_yale_b] [--out PRED]

writes PRED/SUBJECT/SOURCE/LIGHT.npy, 168x192, aligned with the source, then runs the benchmark's scorer. The
pictures are close to linear in light and taken as linear; a subject's sources share its frontal landmarks.
"""

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.landmarks import find_faces
from facerf_cli.pipeline import (
    Models,
    crop_face,
    fit_face,
    load_models,
    predict_olat,
    see_face,
    unwrap_face,
    weigh_batches,
)
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, Camera
from facerf_cli.raster.texture import inpaint, sample_texture

SHARED = Path("../shared")
CROP_PX, TEXTURE_SIDE = 512, 256  # as the verbs have them
_DARK = 0.02  # keeps ratios finite in the source's shadows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=SHARED / "data/extended_yale_b", help="the yaleBXX folders"
    )
    parser.add_argument(
        "--bench", type=Path, default=SHARED / "bench/yale_b", help="its yale.py and score.py"
    )
    parser.add_argument("--out", type=Path, default=Path("out/yale_b"), help="folder for the predictions")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--face-model", default="builtin")
    parser.add_argument("--subjects", nargs="*", help="only these, such as yaleB05 (an incomplete set)")
    arguments = parser.parse_args()
    yale = load_yale(arguments.bench)
    data = yale.Yale(str(arguments.data))
    models = load_models(arguments.checkpoint, arguments.face_model, torch.device("cpu"))
    for subject in arguments.subjects or data.subjects:
        relight_subject(models, yale, data, subject, arguments.out / subject)
        print(subject, flush=True)
    score = [sys.executable, str(arguments.bench / "score.py"), "--data", str(arguments.data)]
    score += ["--pred", str(arguments.out), "--json", str(arguments.out / "result.json")]
    subprocess.run(score + (["--partial"] if arguments.subjects else []), check=True)


def load_yale(bench: Path) -> ModuleType:
    """The benchmark's own module of data, lights and cases."""
    spec = importlib.util.spec_from_file_location("yale", bench / "yale.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def relight_subject(models: Models, yale: ModuleType, data, subject: str, folder: Path) -> None:  # type: ignore[no-untyped-def]
    """Write the predictions of all of one subject's cases."""
    frontal = np.repeat(data.source(subject, "frontal")[..., None], 3, -1)
    landmarks_px = find_faces(frontal, subject)[0].landmarks_px
    lights = data.lights(subject)
    directions = torch.tensor(np.array([yale.light_dir(*light) for light in lights]), dtype=torch.float32)
    names = [yale.light_name(*light) for light in lights]
    for source in yale.SOURCES:
        picture = data.source(subject, source)
        targets = [target for _, s, target in data.cases(subject) if s == source]
        weights = torch.stack([target_weights(yale, names, lights, target) for target in targets])
        used = weights.sum(0) > 0
        predicted = relight(models, picture, landmarks_px, directions[used], weights[:, used])
        (folder / source).mkdir(parents=True, exist_ok=True)
        for target, image in zip(targets, predicted, strict=True):
            np.save(folder / source / f"{target}.npy", image.numpy().astype(np.float16))


def target_weights(yale: ModuleType, names: list[str], lights: list[tuple[int, int]], target: str) -> Tensor:
    """Weight [L] of every light of a subject under one target, a single light or an environment."""
    if target in yale.ENV:
        return torch.from_numpy(yale.env_weights(target, lights)).float()
    return torch.tensor([float(name == target) for name in names])


def relight(
    models: Models, picture: np.ndarray, landmarks_px: np.ndarray, directions: Tensor, weights: Tensor
) -> Tensor:
    """Pictures [M, H, W] of a grey source [H, W] under M sums, weights [M, L], of lights [L, 3]."""
    photo = np.repeat(picture[..., None], 3, -1).astype(np.float32)
    crop, cropped = crop_face(photo, landmarks_px, CROP_PX)
    fit = fit_face(models.face, crop, landmarks_px, photo.shape)
    face = unwrap_face(models.face, fit, cropped, TEXTURE_SIDE, photo.shape)
    grey_weights = weights[..., None].expand(-1, -1, 3)
    textures = weigh_batches(predict_olat(models, face, directions), grey_weights).mean(1)  # [M, T, T]
    height, width = picture.shape
    centre_px = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    camera = Camera(CROP_FOCAL_PER_SIDE * crop.side_px, width, height, *centre_px)
    uv, covered = see_face(fit.vertices_camera(models.face), camera)
    relit = sample_texture(torch.cat([textures, face.texture.mean(0)[None]]), uv).permute(2, 0, 1)
    return fill_uncovered(relit[:-1], relit[-1], torch.from_numpy(photo[..., 0]), covered)


def fill_uncovered(relit: Tensor, source: Tensor, photo: Tensor, covered: Tensor) -> Tensor:
    """Pictures [M, H, W] that go on beyond the mesh: the photo times the nearest change of light."""
    change = inpaint((relit + _DARK) / (source + _DARK) * covered, covered)
    return covered * relit + (1 - covered) * (change * (photo + _DARK) - _DARK).clamp_min(0)


if __name__ == "__main__":
    main()
