"""The Python API: what a notebook calls (docs/python.md); the pipeline does the work.

Images are scene-linear Rec.709, float32 [H, W, 3], of numpy or torch; angles in degrees; the units of light
are those of the command line (docs/design.md).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import torch
from torch import Tensor

from facerf_cli import pipeline
from facerf_cli.api.light import Array, Light, linear_pixels, rig
from facerf_cli.api.person import Person, PhotoCamera, one_of, read_person
from facerf_cli.baselines import RelightKind
from facerf_cli.errors import UsageError
from facerf_cli.face.crop import check_in_photo, check_landmarks
from facerf_cli.face.fit import Geometry
from facerf_cli.files import read, write
from facerf_cli.network.files import checkpoint_file
from facerf_cli.portrait.find import FaceBox, face_at
from facerf_cli.relighting import White
from facerf_cli.relighting.models import LARGEST_TEXTURE, Models
from facerf_cli.relighting.models import load_models as load

__all__ = ["Light", "Person", "PhotoCamera", "fit", "load_models", "read_image", "rig", "write_image"]


def read_image(path: str | Path, colourspace: str | None = None) -> np.ndarray:
    """Read an image or a map as scene-linear Rec.709 [H, W, 3]; `colourspace` overrides the file's."""
    return read.read_image(Path(path), colourspace).pixels


def write_image(path: str | Path, pixels: Array, exposure: float | Literal["auto"] = 0.0) -> None:
    """Write [H, W, 3] or [H, W, 4] as EXR, or at an exposure in EV as 8-bit PNG or JPEG, by the suffix."""
    values = pixels.detach().cpu().numpy() if isinstance(pixels, Tensor) else pixels
    if values.ndim != 3 or values.shape[2] not in (3, 4):
        raise ValueError(f"pixels have shape {list(values.shape)}, not [H, W, 3] or [H, W, 4]")
    path, colour = Path(path), np.ascontiguousarray(values[..., :3], np.float32)
    alpha = values[..., 3] if values.shape[-1] == 4 else None
    if path.suffix.lower() == ".exr":
        write.write_exr(path, colour, alpha)
    else:
        write.write_display(path, colour, exposure, alpha)


def load_models(
    checkpoint: str | Path | Sequence[str | Path] | None = None,
    face_model: str | Path = "builtin",
    device: str | torch.device = "cpu",
    form: str | None = None,
) -> Models:
    """Load networks (None: the shipped ones) and a face model; `device` is cpu, cuda, cuda:1, mps.

    Of several checkpoints, or runs' folders, each serves the networks that its last training trained.
    `form` is package.module:Class, an installed class of a Reflectance Network of your own.
    """
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError):
        raise UsageError(f"device {device}: torch finds no such device; give cpu, cuda or mps") from None
    given = [checkpoint] if isinstance(checkpoint, (str, Path)) else checkpoint or ()
    return load([checkpoint_file(Path(path)) for path in given], face_model, torch.device(device), form)


@overload
def fit(models: Models, photo: Array, *choices: Any, **more: Any) -> Person: ...
@overload
def fit(models: Models, photo: Sequence[Array], *choices: Any, **more: Any) -> list[Person]: ...
def fit(
    models: Models,
    photo: Array | Sequence[Array],
    landmarks_px: Any = None,
    geometry: Geometry | None = None,
    reflectance: RelightKind = "portrait",
    network_alone: bool = False,
    matte: Any = None,
    texture_side: int | None = None,
    white: White = "photo",
) -> Person | list[Person]:
    """Fit the person with the largest face of a photo, once for all lights.

    Args:
        models: The networks and the face model, from `load_models`.
        photo: Scene-linear [H, W, 3]; a list of photos gives a list of people.
        landmarks_px: The face's 68 landmarks [68, 2] in the photo's pixels, in place of the detector's.
        geometry: "landmarks", or "network": the Geometry Network regresses the head, without landmarks; by
            default as the networks were trained.
        reflectance: "portrait" relights the whole person, "field" the face and what is around it by the
            face's light; "diffuse-sh", "specular-sh", "prt" are the paper's baselines.
        network_alone: Leave out the correction by which the photo's own light gives the photo back.
        matte: The person's share [H, W] of the photo, in place of the networks'.
        texture_side: Side of the face's texture in texels; by default that of the networks' training.
        white: Under even white light skin has the colours of the photo; or, of a photo in coloured light, the
            "scene", those without that light.

    Of a list of photos landmarks and mattes are lists, too. Raises InputError where no face is found or the
    fit fails.
    """
    one_of(RelightKind, "reflectance", reflectance)
    one_of(White, "white", white)
    if geometry is not None:
        one_of(Geometry, "geometry", geometry)
    if texture_side is not None and not 16 <= texture_side <= LARGEST_TEXTURE:
        raise ValueError(f"texture_side is {texture_side}, not 16 to {LARGEST_TEXTURE}")
    if network_alone and reflectance not in ("field", "portrait"):
        raise UsageError("network_alone: is for the fields; leave it out, or use reflectance='field'")
    if landmarks_px is not None and geometry == "network":
        raise UsageError("geometry: 'network' uses no landmarks; leave one out")

    def fitted(name: str, photo: Array, landmarks_px: Any, matte: Any) -> Person:
        pixels = linear_pixels(name, photo).detach().clone().numpy()
        if landmarks_px is None:
            chosen = geometry or models.default_geometry
            face: FaceBox = pipeline.find_for(models.networks.people, chosen, pixels, name)[0]
        else:
            face = face_at(check_in_photo(check_landmarks(landmarks_px), *pixels.shape[:2]))
        if matte is not None:
            matte = linear_pixels("matte", matte, "[H, W]").detach().numpy().clip(0, 1)
            if matte.shape != pixels.shape[:2]:
                raise ValueError(f"matte has shape {list(matte.shape)}, not that of the photo")
        head = pipeline.head_of(models, pixels, face, models.sides(texture_side), matte)
        kind, tensors = reflectance, isinstance(photo, Tensor)
        return read_person(models, pixels, head, kind, network_alone, matte, tensors, white)

    if not isinstance(photo, Sequence):
        return fitted("photo", photo, landmarks_px, matte)
    more = ([None] * len(photo) if given is None else given for given in (landmarks_px, matte))
    return [fitted(f"photo {number}", *one) for number, one in enumerate(zip(photo, *more, strict=True))]
