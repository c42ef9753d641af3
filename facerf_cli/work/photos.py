"""Photos of a batch: read them, find and fit their faces; the models are loaded once per process."""

import logging
import math
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli.batch.inputs import Item, companions
from facerf_cli.batch.settings import torch_device
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import Head
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.files.image_metadata import Provenance
from facerf_cli.files.read import LinearImage, read_array, read_image
from facerf_cli.image.colour import named_space, to_display
from facerf_cli.image.strips import resized
from facerf_cli.network.files import serving_files
from facerf_cli.person import find_faces
from facerf_cli.portrait.confidence import SCALES, confidence_of, face_facts, given_matte_facts
from facerf_cli.portrait.find import Face, face_with
from facerf_cli.portrait.person import unit_normals
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.raster.camera import pose_to_rotation, rotation_to_pose
from facerf_cli.relighting.fitting import head_of
from facerf_cli.relighting.memory import KEPT_PX, beside
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.relighting.portrait_field import SmoothedFrame
from facerf_cli.run.logs import LOGGER_NAME, step
from facerf_cli.run.threads import compute_apart
from facerf_cli.work.photo_options import PhotoOptions, parse_pose

_WHITE = 0.9  # least maximum of a --person matte
_LABEL = 1.5 / 255  # a --matte whose maximum is below it contains labels 0 and 1, of 8 or 16 bits
_MOST_RADIANCE = 1e10  # the sun in cd/m2 is below it, and sums of its square are finite
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class PhotoFace:
    """One face of a photo.

    Attributes:
        tag: Part of its outputs' names: '' or, with `--face all`, '_face0'.
        name: Its name in messages.
        found: The detected face.
        facts: Measurements of its reliability; those of a shot's frame leave out the frame's own matte.
        number: Its index from the left.
    """

    tag: str
    name: str
    found: Face
    facts: dict[str, float] = field(default_factory=dict)
    number: int = 0

    def see(self, segmentation: Segmentation) -> None:
        """Add the measurements of its person's matte."""
        if self.facts:
            self.facts.update(segmentation.facts)

    def rated(self, quiet: bool = False) -> dict[str, Any]:
        """Return its confidence for the report and, unless `quiet`, log it."""
        if not self.facts:
            return {}
        confidence = confidence_of(self.facts)
        if not quiet:
            reasons = () if confidence.word == "sure" else confidence.reasons
            why = ", ".join(SCALES[name].said or name for name in reasons)
            log.info("%s: detection is %s%s", self.name, confidence.word, f" ({why})" if why else "")
        factors = {name: round(factor, 3) for name, factor in confidence.factors.items()}
        return {"confidence": round(confidence.score, 3), "certainty": confidence.word, "factors": factors}


@dataclass(frozen=True, eq=False)
class FittedFace(PhotoFace):
    """A face with its head; `steady` belongs to a shot's frame, `matte` [H, W] is the user's."""

    head: Head = field(kw_only=True)
    steady: SmoothedFrame | None = None
    matte: np.ndarray | None = None

    @property
    def fit(self) -> FaceFit:
        return self.head.fit

    def described(self) -> dict[str, Any]:
        """Return its fit, pose and confidence for the report; log the confidence unless it is of a shot."""
        pose_deg = [round(angle, 2) for angle in rotation_to_pose(self.fit.rotation)]
        return {**fit_facts(self.fit), "pose_deg": pose_deg, **self.rated(quiet=self.steady is not None)}


@step("load")
def prepare_photos(options: PhotoOptions, uses: Collection[str], with_networks: bool = True) -> None:
    """Load what every photo needs, and the networks named in `uses`.

    Raises UsageError or InputError for options that would fail all photos, and for an unused checkpoint.
    """
    if options.colourspace is not None:
        named_space(options.colourspace, options.ocio_config)
    face_model(options)
    settings, models = options.settings, load_models_once(options)
    if (options.geometry or models.default_geometry) == "network":
        if options.face_model != BUILTIN:
            raise UsageError(
                f"--face-model {options.face_model}: --geometry network supports only the built-in model; "
                "remove it, or use --geometry landmarks"
            )
        uses = {*uses, "geometry"}
    if not settings.checkpoints_by_default:
        serving_files(settings.checkpoints, uses, "this line")
    if with_networks:
        models.networks.load(uses)


@cache
def load_models_once(options: PhotoOptions) -> Models:
    """Load the face model and the networks of the checkpoints, on the device."""
    compute_apart()
    settings = options.settings
    return load_models(settings.checkpoints, options.face_model, torch_device(settings), options.form)


@cache
def face_model(options: PhotoOptions) -> MorphableModel:
    """Load only the face model."""
    return load_face_model(options.face_model)


@step("read")
def read_photo(
    item: Item, options: PhotoOptions, kept_px: int = KEPT_PX, in_shot: bool = False
) -> LinearImage:
    """Read the item's image, scene-linear Rec.709; later work takes `kept_px` bytes of memory per pixel.

    Alpha that is 0 everywhere is removed, with a warning, unless the image is a frame of a shot or black.
    """
    space = None if options.colourspace is None else named_space(options.colourspace, options.ocio_config)
    image = read_image(item.input_path, space, kept_px=kept_px, layer=options.layer)
    if (most := float(image.pixels.max())) > _MOST_RADIANCE:
        raise InputError(f"{item.input_path}: its maximum is {most:.3g}; clip it to {_MOST_RADIANCE:.0e}")
    if image.alpha is not None and not in_shot and not image.alpha.any() and most > 0:
        log.warning("%s: transparent everywhere; ignoring its alpha", item.input_path)
        return replace(image, alpha=None)
    return image


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Prefix the errors of the block with the name of the input, once."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: " + str(error).removeprefix(f"{name}: ")) from None


def fit_each(item: Item, image: LinearImage, options: PhotoOptions) -> Iterator[FittedFace]:
    """Find the faces of a photo that the options choose, and fit one after the other, from right to left.

    The first face's files are therefore written last, and mark the photo as finished.
    """
    models, matte = load_models_once(options), person_matte(item, image.pixels, options)
    sides = models.sides(options.texture_side)
    for face in reversed(find_people(item, image, options, matte)):
        with naming(face.name):
            head = head_of(models, image.pixels, face.found, options.geometry, sides, matte)
        yield fitted_face(face, head, matte)


def fit_faces(item: Item, image: LinearImage, options: PhotoOptions) -> list[FittedFace]:
    """Fit the faces of a photo that the options choose; return them from left to right."""
    return list(fit_each(item, image, options))[::-1]


def write_each(
    item: Item, image: LinearImage, options: PhotoOptions, write: Callable[[FittedFace], dict[str, Any]]
) -> tuple[list[str], dict[str, Any]]:
    """Fit, write and rate one face after the other.

    Returns their tags and their facts for the report, including those that `write` returns.
    """
    faces: list[tuple[str, dict[str, Any]]] = []
    people = load_models_once(options).networks.people
    for face in fit_each(item, image, options):
        added, landmarks_px = write(face), face.fit.crop.to_photo(face.head.landmarks_px)
        if face.facts and face.matte is None and "disputed" not in face.facts:  # not segmented by `write`
            face.see(segment(people, to_display(image.pixels), landmarks_px, None, face.head.others))
        faces.insert(0, (face.tag, face.described() | added))
    return [tag for tag, _ in faces], facts_of([facts for _, facts in faces], options)


def find_people(
    item: Item, image: LinearImage, options: PhotoOptions, matte: np.ndarray | None
) -> list[PhotoFace]:
    """Find the faces that the options choose, from left to right.

    Raises InputError if the user's landmarks or matte [H, W] do not show the face.
    """
    models, name = load_models_once(options), str(item.input_path)
    if options.landmarks is not None:
        path = companion(item, options.landmarks, "--landmarks")
        landmarks_px = read_landmarks(path)
        with naming(path):
            faces = [face_with(models.networks.people, to_display(image.pixels), landmarks_px)]
    else:
        faces = find_faces(models, image.pixels, options.face, name)
    people = []
    for face in faces:
        number, (left, top, right, bottom) = face.number, face.box_px
        x_px, y_px = round((left + right) / 2), round((top + bottom) / 2)
        which = f": face {number} from the left, at x {x_px}, y {y_px} px" if len(faces) > 1 else ""
        facts = facts_of_face(item, face, image.pixels, options, matte)
        tag = f"_face{number}" if options.face == "all" else ""
        people.append(PhotoFace(tag, name + which, face, facts, number=number))
    return people


def facts_of_face(
    item: Item, face: Face, photo: np.ndarray, options: PhotoOptions, matte: np.ndarray | None
) -> dict[str, float]:
    """Measure a face in a photo [H, W, 3], and the user's matte [H, W].

    Raises InputError if the matte does not show the face.
    """
    if (view := face.view) is None:
        return {}
    facts = face_facts(view, photo)
    if matte is None:
        return facts
    with naming(_matte_path(item, options)):
        return facts | given_matte_facts(view, matte)


def fit_facts(fit: FaceFit) -> dict[str, Any]:
    """Return a fit's error and quality for the report; a regressed head has no error."""
    error = {} if math.isnan(fit.error_iod) else {"error_iod": round(fit.error_iod, 5)}
    return {**error, "quality": fit.quality}


def facts_of(faces: list[dict[str, Any]], options: PhotoOptions) -> dict[str, Any]:
    """Return the facts of a photo's one face, or of each face in a list, and the networks, for the report."""
    return (faces[0] if len(faces) == 1 else {"faces": faces}) | facts_of_networks(options)


def facts_of_networks(options: PhotoOptions) -> dict[str, Any]:
    """Return file and digest of each network that was used, for the report."""
    return {"networks": load_models_once(options).networks.served()}


def stamp(item: Item) -> dict[str, str | int]:
    """Return the metadata of an output that is still a photograph, such as a cut-out."""
    return Provenance(item.input_path.name, source_type="", key=item.key).attributes()


def provenance(item: Item, options: PhotoOptions, checkpoint_name: str = "") -> dict[str, str | int]:
    """Return the metadata of a synthetic output of a photo."""
    stamp_of_model = face_model(options).stamp
    return Provenance(item.input_path.name, checkpoint_name, **stamp_of_model, key=item.key).attributes()


def fitted_face(face: PhotoFace, head: Head, matte: np.ndarray | None) -> FittedFace:
    """Add a face's head, and its person's matte [H, W]; warn if the fit is poor."""
    if head.fit.quality == "poor":
        log.warning(
            "%s: the face model fits poorly (landmarks are off by %.1f %% of the eye distance); check it "
            "with `facerf fit-geometry`, or pass --landmarks",
            face.name,
            100 * head.fit.error_iod,
        )
    return FittedFace(face.tag, face.name, face.found, face.facts, number=face.number, head=head, matte=matte)


def companion(item: Item, path: Path, option: str) -> Path:
    """Return the file of an option that goes with a photo; raise InputError if there is none."""
    places = companions(item, path, option)
    for place in places:
        if place == path or place.is_file():
            return place
    missing = str(places[0])
    if path.is_dir():
        kinds = " ".join(dict.fromkeys(place.suffix for place in places))
        missing = f"{places[0].with_suffix('')} with one of the suffixes {kinds}"
    raise InputError(f"{item.input_path}: {option} has no {missing}; add it there")


def read_matte(item: Item, file: Path, size_px: tuple[int, ...], in_shot: bool = False) -> np.ndarray:
    """Read a photo's --matte [H, W] in 0..1: the file's alpha, or the mean of its channels."""
    path = companion(item, file, "--matte")
    matte = _grey_or_alpha(path, size_px, _LABEL)
    if matte.shape != tuple(size_px):
        raise InputError(f"{path}: {_sizes(matte, size_px)}; use a matte of the photo's size")
    if not in_shot and not matte.any():
        log.warning("%s: the matte is black and masks out all of %s", path, item.input_path)
    return matte


def read_normals(item: Item, file: Path | None, size_px: tuple[int, ...]) -> np.ndarray | None:
    """Read a photo's normals [H, W, 3] of `--normals-from`, at its size, 0 where they are missing.

    EXR and NumPy files contain vectors; other images encode -1..1 as 0..1.
    """
    if file is None:
        return None
    path = companion(item, file, "--normals-from")
    with beside(size_px, images=1):
        if path.suffix.lower() == ".npy":
            normals = read_array(path)
        else:
            normals = read_image(path, "linear", non_finite="zero", with_alpha=False).pixels
            normals = normals if path.suffix.lower() == ".exr" else 2 * normals - 1
    with naming(path):
        return unit_normals(normals, (size_px[0], size_px[1]))


def _matte_path(item: Item, options: PhotoOptions) -> Path:
    return item.input_path if options.person is None else companion(item, options.person, "--person")


def person_matte(
    item: Item, pixels: np.ndarray, options: PhotoOptions, in_shot: bool = False
) -> np.ndarray | None:
    """Read the --person matte [H, W] in 0..1 of a photo [H, W, 3], at its size; None without --person.

    Raises InputError if its aspect ratio differs, and unless in a shot, if it is nowhere white.
    """
    height, width = pixels.shape[:2]
    if options.person is None:
        return None
    path = _matte_path(item, options)
    matte = _grey_or_alpha(path, (height, width), _WHITE)
    scale = height / len(matte)
    if abs(width - scale * matte.shape[1]) > 2 * max(1.0, scale):  # sides were rounded
        raise InputError(f"{path}: {_sizes(matte, (height, width))}; use a matte of the upright photo")
    if not in_shot and (most := matte.max()) < _WHITE:
        level = f"nowhere white (at most {255 * most:.0f} of 255)" if most else "completely black"
        raise InputError(f"{path}: the matte is {level}; make it white where the person is")
    return matte if matte.shape == (height, width) else resized(matte, height, width).clip(0, 1)


def _grey_or_alpha(path: Path, size_px: tuple[int, ...], white: float) -> np.ndarray:
    """Read an image for a photo [H, W] as values [h, w] in 0..1: its alpha, if that varies, or its grey.

    If it is black and one colour below `white`, that colour is a label, as in a palette, and becomes 1.
    """
    with beside(size_px, images=1):
        image = read_image(path, "linear")
    alpha = image.alpha
    values = image.pixels if alpha is None or alpha.min() == alpha.max() else alpha[..., None]
    matte = values.mean(-1).clip(0, 1)
    labelled = (values == values.reshape(matte.size, -1)[matte.argmax()]).all(-1)
    if 0 < matte.max() < white and not matte.min() and not matte[~labelled].any():
        log.info("%s: contains black and one colour, which is treated as white", path)
        return labelled.astype(np.float32)
    return np.asarray(matte)


def _sizes(matte: np.ndarray, size_px: tuple[int, ...]) -> str:
    height, width = matte.shape
    return f"the matte has {width} x {height} pixels, the photo {size_px[1]} x {size_px[0]}"


def rotation_of(pose: str | None) -> torch.Tensor | None:
    """Return the head_to_camera rotation [3, 3] of `--pose`; None keeps the photo's pose."""
    pose_deg = parse_pose(pose)
    return None if pose_deg is None else pose_to_rotation(*pose_deg)
