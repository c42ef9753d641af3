"""Photos of a batch: read, their faces found and fitted, and the models loaded once a process."""

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
from facerf_cli.files.arrays import read_array
from facerf_cli.files.read import LinearImage, read_image
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
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.relighting.portrait_field import SmoothedFrame
from facerf_cli.run.logs import LOGGER_NAME, Provenance, step
from facerf_cli.run.threads import compute_apart
from facerf_cli.work.photo_options import PhotoOptions, parse_pose
from facerf_cli.work.plan import KEPT_PX, beside


def companion(item: Item, given: Path, option: str) -> Path:
    """The file of an option that goes with a photo, as `companions` lists; InputError where there is none."""
    places = companions(item, given, option)
    for path in places:
        if path == given or path.is_file():
            return path
    missing = str(places[0])
    if given.is_dir():
        kinds = " ".join(dict.fromkeys(path.suffix for path in places))
        missing = f"{places[0].with_suffix('')} with one of the suffixes {kinds}"
    raise InputError(f"{item.input_path}: {option} has no {missing}; add it there")


_WHITE, _LABEL = 0.9, 1.5 / 255  # of mattes: the least white, and what only label 1 of 8 or 16 bits is below
_MOST_RADIANCE = 1e10  # in a photo: the sun in cd/m2 is below it, and sums of its square are finite
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class PhotoFace:
    """One face of a photo; `tag` goes into the names of its outputs: '' or, with `--face all`, '_face0'.

    `name` is for messages. `facts` say how far it can be relied on; those of a frame leave out its own matte.
    """

    tag: str
    name: str
    found: Face
    facts: dict[str, float] = field(default_factory=dict)
    number: int = 0  # from the left

    def see(self, segmentation: Segmentation) -> None:
        """Add the facts of its person's matte."""
        if self.facts:
            self.facts.update(segmentation.facts)

    def rated(self, quiet: bool = False) -> dict[str, Any]:
        """Rate the face for the report, and unless `quiet` in a line."""
        if not self.facts:
            return {}
        confidence = confidence_of(self.facts)
        why = ", ".join(SCALES[name].said or name for name in confidence.reasons)
        if not quiet:
            log.info(
                "%s: facerf is %s of the person%s", self.name, confidence.word, f" ({why})" if why else ""
            )
        factors = {name: round(factor, 3) for name, factor in confidence.factors.items()}
        return {"confidence": round(confidence.score, 3), "certainty": confidence.word, "factors": factors}


@dataclass(frozen=True, eq=False)
class FittedFace(PhotoFace):
    """A face with its head; `steady` is of a frame of a shot, `matte` [H, W] is the person's if given."""

    head: Head = field(kw_only=True)
    steady: SmoothedFrame | None = None
    matte: np.ndarray | None = None

    @property
    def fit(self) -> FaceFit:
        """The fitted face model."""
        return self.head.fit

    def described(self) -> dict[str, Any]:
        """Describe the face for the report, and unless it is of a shot in a line."""
        pose_deg = [round(angle, 2) for angle in rotation_to_pose(self.fit.rotation)]
        return {**fit_facts(self.fit), "pose_deg": pose_deg, **self.rated(quiet=self.steady is not None)}


@step("load")
def prepare_photos(options: PhotoOptions, uses: Collection[str], with_networks: bool = True) -> None:
    """Load what every photo needs, and the networks of some names.

    Raises UsageError or InputError for what would fail all photos, and for a checkpoint without use.
    """
    if options.colourspace is not None:
        named_space(options.colourspace, options.ocio_config)
    face_model(options)
    settings, models = options.settings, load_models_once(options)
    if (options.geometry or models.default_geometry) == "network":
        if options.face_model != BUILTIN:
            raise UsageError(
                f"--face-model {options.face_model}: --geometry network regresses heads of the built-in one; "
                "leave it out, or give --geometry landmarks"
            )
        uses = {*uses, "geometry"}
    if not settings.checkpoints_by_default:
        serving_files(settings.checkpoints, uses, "this line")
    if with_networks:
        models.networks.load(uses)


@cache
def load_models_once(options: PhotoOptions) -> Models:
    """The face model and the networks of the checkpoint, on the device, once a process."""
    compute_apart()
    settings = options.settings
    return load_models(settings.checkpoints, options.face_model, torch_device(settings), options.form)


@cache
def face_model(options: PhotoOptions) -> MorphableModel:
    """The face model alone, once a process."""
    return load_face_model(options.face_model)


@step("read")
def read_photo(
    item: Item, options: PhotoOptions, kept_px: int = KEPT_PX, in_shot: bool = False
) -> LinearImage:
    """The item's image, scene-linear Rec.709; it leads to `kept_px` bytes of memory a pixel.

    Alpha that is 0 everywhere, over colour, is none, with a warning; of a frame of a shot it is kept.
    """
    space = None if options.colourspace is None else named_space(options.colourspace, options.ocio_config)
    image = read_image(item.input_path, space, kept_px=kept_px, layer=options.layer)
    if (most := float(image.pixels.max())) > _MOST_RADIANCE:
        raise InputError(
            f"{item.input_path}: its brightest value is {most:.3g}, and {_MOST_RADIANCE:.0e} is the most; "
            "clip it"
        )
    if image.alpha is not None and not in_shot and not image.alpha.any() and most > 0:
        log.warning("%s: is transparent everywhere; its alpha is left out", item.input_path)
        return replace(image, alpha=None)
    return image


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Let errors of the block begin with the name of the input, once."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: " + str(error).removeprefix(f"{name}: ")) from None


def fit_each(item: Item, image: LinearImage, options: PhotoOptions) -> Iterator[FittedFace]:
    """Find the faces of a photo that the options choose; fit one after the other, from right to left.

    So the first one's files are written last, and mark the photo as finished.
    """
    matte = person_matte(item, image.pixels, options)
    found = find_people(item, image, options, matte)
    return (_fitted(found.pop(), image, options, matte) for _ in range(len(found)))


def fit_faces(item: Item, image: LinearImage, options: PhotoOptions) -> list[FittedFace]:
    """Fit the faces of a photo that the options choose, from left to right."""
    return list(fit_each(item, image, options))[::-1]


def write_each(
    item: Item, image: LinearImage, options: PhotoOptions, write: Callable[[FittedFace], dict[str, Any]]
) -> tuple[list[str], dict[str, Any]]:
    """Fit, write and rate one face after the other.

    Return their tags and their entries in the report, to which `write` may add.
    """
    made: list[tuple[str, dict[str, Any]]] = []
    people = load_models_once(options).networks.people
    for face in fit_each(item, image, options):
        added, landmarks_px = write(face), face.fit.crop.to_photo(face.head.landmarks_px)
        face.see(segment(people, to_display(image.pixels), landmarks_px, face.matte, face.head.others))
        made.insert(0, (face.tag, face.described() | added))
    return [tag for tag, _ in made], facts_of([facts for _, facts in made], options)


def find_people(
    item: Item, image: LinearImage, options: PhotoOptions, matte: np.ndarray | None
) -> list[PhotoFace]:
    """Find the faces that the options choose, from left to right.

    Raises InputError for given landmarks, or a given matte [H, W], that do not show the face.
    """
    models = load_models_once(options)
    if options.landmarks is not None:
        path = companion(item, options.landmarks, "--landmarks")
        landmarks_px = read_landmarks(path)
        with naming(path):
            faces = [face_with(models.networks.people, to_display(image.pixels), landmarks_px)]
    else:
        faces = find_faces(models, image.pixels, options.face, str(item.input_path))
    found = []
    for face in faces:
        name, number, (left, top, right, bottom) = str(item.input_path), face.number, face.box_px
        if len(faces) > 1:
            x_px, y_px = round((left + right) / 2), round((top + bottom) / 2)
            name += f": face {number} from the left, at x {x_px}, y {y_px} px"
        facts = facts_of_face(item, face, image.pixels, options, matte)
        found.append(
            PhotoFace(f"_face{number}" if options.face == "all" else "", name, face, facts, number=number)
        )
    return found


def facts_of_face(
    item: Item, face: Face, photo: np.ndarray, options: PhotoOptions, matte: np.ndarray | None
) -> dict[str, float]:
    """Measure a face in a photo [H, W, 3], and its matte [H, W] if that is given.

    Raises InputError for a matte that does not show it.
    """
    if (view := face.view) is None:
        return {}
    facts = face_facts(view, photo)
    if matte is None:
        return facts
    with naming(matte_path(item, options)):
        return facts | given_matte_facts(view, matte)


def fit_facts(fit: FaceFit) -> dict[str, Any]:
    """A fit's error and quality for the report; a regressed head has no error."""
    error = {} if math.isnan(fit.error_iod) else {"error_iod": round(fit.error_iod, 5)}
    return {**error, "quality": fit.quality}


def facts_of(faces: list[dict[str, Any]], options: PhotoOptions) -> dict[str, Any]:
    """The report's entries of a photo: those of its one face, or of each in a list."""
    return (faces[0] if len(faces) == 1 else {"faces": faces}) | facts_of_networks(options)


def facts_of_networks(options: PhotoOptions) -> dict[str, Any]:
    """Return the report's entries of the networks that were used: file and digest of each."""
    return {"networks": load_models_once(options).networks.served()}


def stamp(item: Item) -> dict[str, str | int]:
    """Metadata for parts of a photo, which stay photographs."""
    return Provenance(item.input_path.name, source_type="", key=item.key).attributes()


def provenance(item: Item, options: PhotoOptions, checkpoint_name: str = "") -> dict[str, str | int]:
    """Metadata for the outputs of a photo."""
    stamp_of_model = face_model(options).stamp
    return Provenance(item.input_path.name, checkpoint_name, **stamp_of_model, key=item.key).attributes()


def _fitted(
    face: PhotoFace, image: LinearImage, options: PhotoOptions, matte: np.ndarray | None
) -> FittedFace:
    with naming(face.name):
        models = load_models_once(options)
        sides = models.sides(options.texture_side)
        head = head_of(models, image.pixels, face.found, options.geometry, sides, matte)
    return fitted_face(face, head, matte)


def fitted_face(face: PhotoFace, head: Head, matte: np.ndarray | None) -> FittedFace:
    """A face with its head, and its person's matte [H, W] if given; warns of a fit that is poor."""
    if head.fit.quality == "poor":
        log.warning(
            "%s: the face model fits badly (its points are off by %.1f %% of the eyes' distance): look at it "
            "with `facerf fit-geometry`, or give the face's points by --landmarks",
            face.name,
            100 * head.fit.error_iod,
        )
    return FittedFace(face.tag, face.name, face.found, face.facts, number=face.number, head=head, matte=matte)


def read_matte(item: Item, given: Path, size_px: tuple[int, ...], in_shot: bool = False) -> np.ndarray:
    """A photo's matte [H, W] in 0..1, of the photo's size: the file's alpha, or the mean of its values."""
    path = companion(item, given, "--matte")
    matte = _grey_or_alpha(path, size_px, _LABEL)
    if matte.shape != tuple(size_px):
        raise InputError(f"{path}: {_sizes(matte, size_px)}; give one of the photo's size")
    if not in_shot and not matte.any():
        log.warning("%s: the matte is black, and leaves out all of %s", path, item.input_path)
    return matte


def read_normals(item: Item, given: Path | None, size_px: tuple[int, ...]) -> np.ndarray | None:
    """A photo's normals [H, W, 3] of `--normals-from`, at its size, 0 where none are; None if not given.

    An EXR and NumPy's file hold vectors; in other images 0..1 stand for -1..1.
    """
    if given is None:
        return None
    path = companion(item, given, "--normals-from")
    with beside(size_px, images=1):
        if path.suffix.lower() == ".npy":
            normals = read_array(path)
        else:
            normals = read_image(path, "linear", non_finite="zero", with_alpha=False).pixels
            normals = normals if path.suffix.lower() == ".exr" else 2 * normals - 1
    with naming(path):
        return unit_normals(normals, (size_px[0], size_px[1]))


def matte_path(item: Item, options: PhotoOptions) -> Path:
    """Return the file of a photo's `--person`; without it, the photo."""
    return item.input_path if options.person is None else companion(item, options.person, "--person")


def person_matte(
    item: Item, pixels: np.ndarray, options: PhotoOptions, in_shot: bool = False
) -> np.ndarray | None:
    """The person's matte [H, W] in 0..1 that is given for a photo [H, W, 3], at its size; None if none is.

    Raises InputError where that of a photo alone is black, or that of `--person` nowhere white.
    """
    height, width = pixels.shape[:2]
    if options.person is None:
        return None
    path = matte_path(item, options)
    matte = _grey_or_alpha(path, (height, width), _WHITE)
    scale = height / len(matte)
    if abs(width - scale * matte.shape[1]) > 2 * max(1.0, scale):  # sides were rounded
        sizes, turned = _sizes(matte, (height, width)), abs(height - width * matte.shape[1] / len(matte)) <= 2
        cause = "; the likely cause: the photo's EXIF orientation was not applied" if turned else ""
        raise InputError(f"{path}: {sizes}{cause}; use a matte of the upright photo")
    if not in_shot and not matte.any():
        raise InputError(f"{path}: the matte is black and shows nobody; make it white where the person is")
    if not in_shot and (most := matte.max()) < _WHITE:
        at_most = f"nowhere white, {255 * most:.0f} of 255 at most"
        raise InputError(f"{path}: the matte is {at_most}; make it white where the person is")
    return matte if matte.shape == (height, width) else resized(matte, height, width).clip(0, 1)


def _grey_or_alpha(path: Path, size_px: tuple[int, ...], white: float) -> np.ndarray:
    """Values [h, w] in 0..1 of an image for a photo [H, W]: its alpha, if that varies, or its grey.

    Of black and one colour, less bright than `white`, the colour is a label, as of a palette: it reads white.
    """
    with beside(size_px, images=1):
        image = read_image(path, "linear")
    alpha = image.alpha
    values = image.pixels if alpha is None or alpha.min() == alpha.max() else alpha[..., None]
    matte = values.mean(-1).clip(0, 1)
    labelled = (values == values.reshape(matte.size, -1)[matte.argmax()]).all(-1)
    if 0 < matte.max() < white and not matte.min() and not matte[~labelled].any():
        log.info("%s: is black and one colour, which counts as white", path)
        return labelled.astype(np.float32)
    return np.asarray(matte)


def _sizes(matte: np.ndarray, size_px: tuple[int, ...]) -> str:
    height, width = matte.shape
    return f"the matte has {width} x {height} pixels, the photo {size_px[1]} x {size_px[0]}"


def rotation_of(pose: str | None) -> torch.Tensor | None:
    """The head_to_camera rotation [3, 3] of `--pose`; None keeps the photo's pose."""
    pose_deg = parse_pose(pose)
    return None if pose_deg is None else pose_to_rotation(*pose_deg)
