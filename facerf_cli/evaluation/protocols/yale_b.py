"""What others reach on Extended Yale B: the benchmark's own figures, of the same pictures.

From the README of that benchmark, over 21 subjects: Si-MSE and SSIM by kind of source and target, and Si-MSE
by the angle between flash and camera. DPR: Zhou et al., ICCV 2019. GeomConsistentFR: Hou et al., CVPR 2022.
The methods in `TOLD_MORE` learn from other subjects under the same flashes, which one photo does not tell.

Real people relit to real point lights, held against their pictures under them (Extended Yale B).

Each source picture is taken as a user's photo is: fitted, unwrapped, explained by the method, relit under all
of its targets at once and rendered into its own frame. The light is given here and not estimated. Beyond the
mesh a picture goes on as the photo times the nearest change of light, for crops and mask reach past it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.capture.yale_b import YaleB
from facerf_cli.evaluation.case import Case, Comparison
from facerf_cli.evaluation.methods import Method
from facerf_cli.evaluation.protocols.yale_b_cases import (
    ANGLES_DEG,
    SETTINGS_SUBJECTS,
    Question,
    Sitter,
    face_mask,
)
from facerf_cli.evaluation.summary import Layout, Published
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.landmarks import find_faces
from facerf_cli.pipeline import FaceTexture, Models, crop_face, fit_face, see_face, see_head, unwrap_face
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, Camera
from facerf_cli.raster.texture import inpaint, sample_texture

COLUMNS = ("frontal", "soft", "environment")
PEERS = ("DPR", "GeomConsistentFR")
SHOWN = ("copy of the source", *PEERS, "quotient image")  # beside ours
TOLD_MORE = ("others' mean", "others' Lambert", "quotient image")
PUBLISHED_SUBJECTS = 21
_SOURCE = "Yale B"
_SAME = f"same pictures, {PUBLISHED_SUBJECTS} people"
_KNOWS = _SAME + ", told more"

# (Si-MSE, SSIM) by column, then Si-MSE by angle.
FIGURES: dict[str, tuple[tuple[tuple[float, float], ...], tuple[float, ...]]] = {
    "copy of the source": (
        ((0.0299, 0.609), (0.0512, 0.495), (0.0361, 0.646)),
        (0.0044, 0.0122, 0.0308, 0.0540, 0.0570),
    ),
    "DPR": (
        ((0.0111, 0.686), (0.0131, 0.641), (0.0145, 0.729)),
        (0.0057, 0.0080, 0.0122, 0.0164, 0.0155),
    ),
    "GeomConsistentFR": (
        ((0.0119, 0.674), (0.0151, 0.629), (0.0145, 0.709)),
        (0.0055, 0.0101, 0.0139, 0.0178, 0.0145),
    ),
    "others' mean": (
        ((0.0123, 0.610), (0.0123, 0.619), (0.0121, 0.654)),
        (0.0123, 0.0129, 0.0131, 0.0150, 0.0100),
    ),
    "others' Lambert": (
        ((0.0092, 0.672), (0.0125, 0.616), (0.0109, 0.760)),
        (0.0025, 0.0055, 0.0119, 0.0151, 0.0134),
    ),
    "quotient image": (
        ((0.0074, 0.751), (0.0093, 0.724), (0.0078, 0.789)),
        (0.0024, 0.0046, 0.0094, 0.0120, 0.0105),
    ),
}


def published() -> tuple[Published, ...]:
    """The rows to stand beside ours."""
    rows: list[Published] = []

    def add(method: str, metric: str, mean: float, group: tuple[str, str], digits: int) -> None:
        data = _KNOWS if method in TOLD_MORE else _SAME
        rows.append(Published(method, metric, mean, None, group, _SOURCE, data, digits))

    for method in SHOWN:
        by_column, by_angle = FIGURES[method]
        for column, (si_mse, ssim) in zip(COLUMNS, by_column, strict=True):
            add(method, "si_mse", si_mse, ("column", column), 4)
            add(method, "ssim", ssim, ("column", column), 3)
        for (low, high), si_mse in zip(pairwise(ANGLES_DEG), by_angle, strict=True):
            add(method, "si_mse", si_mse, ("angle", f"{low}-{high} deg"), 4)
    return tuple(rows)


CROP_PX, TEXTURE_SIDE = 512, 256  # as the verbs have them
_DARK = 0.02  # keeps ratios finite in the source's shadows


@dataclass(frozen=True, eq=False)
class _Seen:
    """A source [H, W] as a checkpoint's networks see it: its fit, its texture, and where its pixels lie."""

    photo: Tensor
    fit: FaceFit
    face: FaceTexture
    uv: Tensor
    covered: Tensor


def layout(database: YaleB, subjects: Sequence[str], network_alone: bool = False) -> Layout:
    """What the tables hold, and what is to be known of the figures."""
    return Layout(
        name="yale-b",
        title="Extended Yale B: real people relit to real point lights",
        metrics=("si_mse", "ssim"),
        by=("column", "angle", "subjects"),
        published=published(),
        notes=tuple(_notes(database, subjects, network_alone)),
    )


def _notes(database: YaleB, subjects: Sequence[str], network_alone: bool) -> Iterator[str]:
    """What is said beside the figures."""
    yield "The field is the network's own." if network_alone else "The field is held to its source picture."
    yield "Grey pictures, values as given, which are close to linear in light; one ellipse is the mask."
    yield "The flashes' strength is not known: metrics without a scale of their own (MSE, PSNR) say little."
    if database.shifts:
        yield "Pictures are moved onto their subject's frontal one by the given shifts."
    else:
        yield "Pictures are taken as they are, without --shifts; the published figures are of aligned ones."
    marked, known = len(database.marked_damaged), len(database.left_out)
    yield f"Left out of all subjects there: {marked} pictures marked as damaged, {known} known to be."
    yield (
        f"Published rows are of the same pictures, aligned, over {PUBLISHED_SUBJECTS} subjects, by the "
        f"benchmark that they come from; here are {len(subjects)}. The quotient image is told more than one "
        "photo: other subjects under the same flashes."
    )
    if chosen := sorted(set(subjects) & set(SETTINGS_SUBJECTS)):
        yield f"Settings were chosen on {', '.join(chosen)}."


def compare_sitter(
    database: YaleB, subject: str, methods: Sequence[Method], held_to_photo: bool = True
) -> Iterator[Comparison]:
    """All of a subject's cases, a source at a time: each method's picture beside the subject's own.

    A subject's sources share the landmarks of its frontal picture. InputError where no face is found in it or
    a picture cannot be read.
    """
    sitter = Sitter(database, subject)
    questions = list(sitter.questions())
    frontal = sitter.image("frontal")
    landmarks_px = find_faces(_rgb(frontal), str(database.folder / subject))[0].landmarks_px
    for source in dict.fromkeys(question.source for question in questions):
        asked = [question for question in questions if question.source == source]
        photo = sitter.image(source)
        relit = _relit_by_all(sitter, photo, landmarks_px, asked, methods, held_to_photo)
        for row, question in enumerate(asked):
            yield Comparison(
                case=_case(subject, question),
                truth=_rgb(sitter.image(question.light)),
                mask=face_mask().astype(np.float32),
                predictions={name: _rgb(images[row]) for name, images in relit.items()},
                source=_rgb(photo),
                grey_as_given=True,
            )


def _case(subject: str, question: Question) -> Case:
    """The case by the path at which the benchmark looks for its prediction."""
    facts: dict[str, str | float] = {"column": question.column, "source": question.source}
    if question.angle_bin is not None:
        facts["angle"] = question.angle_bin
    facts["subjects"] = "settings" if subject in SETTINGS_SUBJECTS else "test"
    if question.angle_deg is not None:
        facts["angle_deg"] = question.angle_deg
    return Case(f"{subject}/{question.source}/{question.light}", subject, facts)


def _rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, -1).astype(np.float32)


def _relit_by_all(
    sitter: Sitter,
    photo: np.ndarray,
    landmarks_px: np.ndarray,
    asked: Sequence[Question],
    methods: Sequence[Method],
    held_to_photo: bool,
) -> Mapping[str, np.ndarray]:
    """By method, a source's pictures [M, H, W] under every light that is asked for."""
    weights = torch.from_numpy(np.stack([sitter.weights(question.light) for question in asked])).float()
    used = weights.sum(0) > 0
    directions = torch.from_numpy(np.stack([flash.direction for flash in sitter.flashes])).float()
    seen: dict[int, _Seen] = {}
    relit = {}
    for method in methods:
        key = id(method.models)  # methods over the same networks share the fit
        if key not in seen:
            seen[key] = _see(method.models, photo, landmarks_px)
        reflectance = method.reflectance(seen[key].fit, seen[key].face, held_to_photo)
        relit[method.name] = _relit(seen[key], reflectance, directions[used], weights[:, used]).numpy()
    return relit


def _see(models: Models, photo: np.ndarray, landmarks_px: np.ndarray) -> _Seen:
    """Fit and unwrap a grey source [H, W], and see its mesh in the source's own frame."""
    pixels = _rgb(photo)
    crop, cropped = crop_face(pixels, landmarks_px, CROP_PX)
    fit = fit_face(models.face, crop, landmarks_px, pixels.shape, see_head(models, cropped))
    face = unwrap_face(models.face, fit, cropped, TEXTURE_SIDE, pixels.shape)
    height, width = photo.shape
    centre_px = crop.x0_px + crop.side_px / 2, crop.y0_px + crop.side_px / 2
    camera = Camera(CROP_FOCAL_PER_SIDE * crop.side_px, width, height, *centre_px)
    uv, covered = see_face(fit.vertices_camera(models.face), camera)
    return _Seen(torch.from_numpy(pixels[..., 0]), fit, face, uv, covered)


def _relit(seen: _Seen, reflectance: Reflectance, directions: Tensor, weights: Tensor) -> Tensor:
    """Pictures [M, H, W], grey and not negative, under M sums, weights [M, L], of lights [L, 3]."""
    grey_weights = weights[..., None].expand(-1, -1, 3)
    textures = reflectance.relit(directions, grey_weights).detach().mean(1).clamp_min(0)
    planes = torch.cat([textures, seen.face.texture.mean(0)[None]])  # [M + 1, T, T]
    images = sample_texture(planes, seen.uv).permute(2, 0, 1)
    return fill_uncovered(images[:-1], images[-1], seen.photo, seen.covered)


def fill_uncovered(relit: Tensor, source: Tensor, photo: Tensor, covered: Tensor) -> Tensor:
    """Pictures [M, H, W] that go on beyond the mesh: the photo times the nearest change of light.

    relit [M, H, W] and source [H, W] are rendered from textures, photo [H, W] is the source itself, covered
    [H, W] is 1 where the mesh is.
    """
    change = inpaint((relit + _DARK) / (source + _DARK) * covered, covered)
    return covered * relit + (1 - covered) * (change * (photo + _DARK) - _DARK).clamp_min(0)
