"""Measured faces, from prepared datasets and photos, and the methods that relight them."""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines import RelightKind, explain_by_baseline
from facerf_cli.baselines.base import Explained, Reflectance
from facerf_cli.batch.inputs import Item
from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import Pair, image_path, load_pairs, sum_sources
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.folders import case_of, read_facts
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.metrics import tone_of
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit, Geometry, fit_from_arrays
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.topology import grid_triangles, grid_uv, interior_mask, region_mask
from facerf_cli.files.olat_stack import StackHeader, read_olat_header
from facerf_cli.files.read import LinearImage, read_image
from facerf_cli.image.skin import skin_albedo
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.files import checkpoint_file
from facerf_cli.person import Person, Target
from facerf_cli.portrait.find import Face, NoFaceError, find_faces
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.relighting.fitting import head_of, reflectance_of
from facerf_cli.relighting.models import Models, Sides, load_models
from facerf_cli.relighting.photo_light import DEFAULT_ESTIMATOR, Estimator, estimate_light
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.estimate_light import feature_network
from facerf_cli.work.photo_options import LightOptions, PhotoOptions, networks_of
from facerf_cli.work.photos import fit_faces, load_models_once, read_photo

_MASK_SIDE = 256  # texels of the masks
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Method:
    """Reflectance model with its name in the tables; it renders the images of `facerf relight`."""

    name: str
    kind: RelightKind
    models: Models
    network_alone: bool = True  # without the ratio image, which makes the field reproduce its photo exactly
    estimator: Estimator = DEFAULT_ESTIMATOR

    def explain(self, head: Head) -> Explained:
        """Estimate reflectance and light from a head's photo."""
        if self.kind == "portrait":
            raise UsageError("--reflectance portrait: requires whole photos; use evaluate yale-b")
        if self.kind != "field":
            return explain_by_baseline(self.models, head, self.kind)
        light = estimate_light(self.models, head, estimator=self.estimator).light
        return Explained(reflectance_of(self.models, head, self.kind, self.network_alone), light)

    def image(
        self, head: Head, reflectance: Reflectance, light: RigLight, fit: FaceFit | None = None
    ) -> np.ndarray:
        """Render only the face [S, S, 3] under one light, in the pose and crop of `fit` or its own."""
        return Person(self.models, None, head, reflectance).image(light, Target(fit))

    def images(
        self, photo: np.ndarray | None, head: Head, lights: Light, target: Target
    ) -> Iterator[np.ndarray]:
        """Yield an image under each weighted sum of lights, inside the photo if there is one.

        In the pose of the target's fit, yield only the face, in the fit's crop.
        """
        reflectance = reflectance_of(self.models, head, self.kind, self.network_alone, photo=photo)
        framed_by = photo if target.fit is None else None
        composition = Person(self.models, framed_by, head, reflectance).prepare(target)
        for relit in composition.relit(lights):
            yield composition.image(relit)


@dataclass(frozen=True, eq=False)
class Bench:
    """Everything that the comparisons of a run share.

    Each image's face is detected, and fitted or regressed according to `geometry`. If `geometry` is None,
    use the heads that a dataset fitted to all calibrated cameras of a person at once.
    """

    models: Models  # detect and fit faces
    sides: Sides
    geometry: Geometry | None = None
    keep_eyes: bool = False  # compare open eyes, which the face field does not learn (paper, 'Results')
    methods: Sequence[Method] = ()
    mean: Models | None = None  # trained with the mean face
    photo: PhotoOptions | None = None  # how photos are read; unused for datasets
    described: Mapping[str, Case] = field(default_factory=dict)  # the rows of --facts

    def find(self, image: np.ndarray, name: str) -> Face:
        """Detect the largest face in an image; raises InputError without a face."""
        return find_faces(self.models.networks.people, image, name)[0]

    def heads(self, photo: np.ndarray, face: Face) -> Iterator[tuple[Method, Head]]:
        """Yield each method with its head of a face; methods with the same models share the fit."""
        heads: dict[int, Head] = {}
        for method in self.methods:
            key = id(method.models)
            if key not in heads:
                heads[key] = head_of(method.models, photo, face, self.geometry)
            yield method, heads[key]


@dataclass(frozen=True, eq=False)
class HeadView:
    """Head rendered in the pose and the crop of `fit`."""

    head: Head
    fit: FaceFit
    uv: Tensor  # [S, S, 2], (u, v) of each pixel
    mask: np.ndarray  # [S, S] in 0..1, the compared pixels: the paper's M_t inside the photo

    @property
    def face(self) -> tuple[np.ndarray, np.ndarray]:
        """Mask [S, S] and landmarks [68, 2] in the head's crop."""
        return self.mask, self.head.landmarks_px

    def region(self, name: str) -> np.ndarray:
        """Return the mask [S, S] in 0..1 of a named region of the face (`face/topology.py`)."""
        return sample_texture(region_mask(name, _MASK_SIDE)[None], self.uv)[..., 0].numpy()


@dataclass(frozen=True, eq=False)
class ComparedFace:
    """Face of a photo. Each method's models fit or regress its head, in a common crop.

    Transparent pixels of the photo are neither compared nor used.
    """

    name: str  # of the photo, in errors
    case: Case
    photo: LinearImage
    face: Face | FaceFit  # as detected, or fitted in advance
    bench: Bench
    origin: "tuple[DatasetPerson, Pair] | None" = None  # for a dataset: the pair whose source is the photo
    _views: dict[int, tuple[Models, HeadView]] = field(default_factory=dict)

    def fit_with(self, models: Models) -> HeadView:
        """Return the head as fitted by a method's models; raises InputError if no part of it is visible."""
        if id(models) not in self._views:
            image, face, sides = self.photo.pixels, self.face, self.bench.sides
            if isinstance(face, FaceFit):
                head = Head(image, face, unwrap_face(models.face, face, image, sides.texture, image.shape))
            else:
                head = head_of(models, image, face, self.bench.geometry, sides)
            view = self._view(models, head, head.fit)
            masked = head.without(models.face, self._inside(head.fit.crop))
            self._views[id(models)] = models, replace(view, head=masked)
        return self._views[id(models)][1]

    def pose_of(self, view: HeadView, models: Models) -> HeadView:
        """Pose another portrait's head like this one."""
        own = self.fit_with(models).fit
        posed = replace(own, alpha=view.fit.alpha, beta=view.fit.beta)
        return self._view(models, view.head, posed)

    def _view(self, models: Models, head: Head, fit: FaceFit) -> HeadView:
        vertices = fit.vertices_camera(models.face)
        fragments = rasterize(vertices, grid_triangles(), fit.camera)
        uv = interpolate(grid_uv(), grid_triangles(), fragments)
        mask = interior_mask(vertices, fragments, uv, _MASK_SIDE)[0]
        if not self.bench.keep_eyes:
            mask = mask * (1 - sample_texture(region_mask("eyes", _MASK_SIDE)[None], uv)[..., 0])
        inside = mask.numpy() * self._inside(fit.crop)
        if not inside.max() > 0:
            raise InputError(f"{self.name}: the fitted face is not visible in the image; pass --landmarks")
        return HeadView(head, fit, uv, inside)

    def _inside(self, crop: Crop) -> np.ndarray:
        """Return the photo's coverage [S, S] in 0..1 of each pixel of a crop."""
        alpha = self.photo.alpha
        inside = crop.valid(*self.photo.pixels.shape[:2]).astype(np.float32)
        return inside if alpha is None else inside * crop.apply(alpha[..., None])[..., 0]


def common_mask(views: Iterable[HeadView]) -> np.ndarray:
    """Intersect the masks [S, S] of all views."""
    return np.minimum.reduce([view.mask for view in views])


@dataclass(frozen=True, eq=False)
class DatasetPerson:
    """Subject of a prepared dataset, with groups of pairs whose sources are compared together."""

    dataset: Dataset
    name: str
    bench: Bench | None = None  # set by `compared`
    groups: Sequence[Sequence[Pair]] = ()
    _lit: dict[str, ComparedFace] = field(default_factory=dict)
    _headers: dict[str, StackHeader] = field(default_factory=dict)

    def compared(self, compare: "Compare", bench: Bench) -> Iterator[Comparison]:
        """Compare each group; skip and log groups with an undetected face.

        Raises UsageError if the dataset's fits use another face model.
        """
        if bench.geometry is None and bench.models.face.name != self.dataset.face_model:
            raise UsageError(
                f"{self.dataset.folder}: its heads are fitted with the face model {self.dataset.face_model}; "
                "pass it as --face-model"
            )
        person = replace(self, bench=bench)
        for pairs in self.groups:
            try:
                comparisons = list(compare([person.source_of(pair) for pair in pairs], bench))
            except NoFaceError as error:
                log.warning("%s: skipped (%s)", " and ".join(map(_name, pairs)), error)
            else:
                yield from comparisons

    def source_of(self, pair: Pair) -> ComparedFace:
        """Return the face in the source of a pair; raises NoFaceError without a face."""
        face = self._compared_face(self.source(pair), pair.source_camera, _name(pair))
        case = replace(face.case, facts=self.facts | {"map": pair.envmap})
        return replace(face, case=case, origin=(self, pair))

    def under_all_lights(self, camera: str) -> ComparedFace:
        """Return the person in a camera under all lights; no detector finds a face under a single light."""
        if camera not in self._lit:
            image = self.header(camera).source
            self._lit[camera] = self._compared_face(image, camera, f"{self.name}/{camera}")
        return self._lit[camera]

    def header(self, camera: str) -> StackHeader:
        """Read the header of a camera's stack, once."""
        if camera not in self._headers:
            self._headers[camera] = read_olat_header(self.dataset.stack_path(self.name, camera))
        return self._headers[camera]

    def _compared_face(self, image: np.ndarray, camera: str, name: str) -> ComparedFace:
        header = self.header(camera)
        assert self.bench is not None
        face: Face | FaceFit
        if self.bench.geometry is None:
            fit = fit_from_arrays(header.fit)
            side_px = fit.crop.size_px  # the crop's pixels are the photo's
            face = replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px))
        else:
            try:
                face = self.bench.find(image, name)
            except InputError as error:
                raise NoFaceError(str(error)) from None
        return ComparedFace(name, Case(name, self.name), LinearImage(image, header.seen), face, self.bench)

    def source(self, pair: Pair) -> np.ndarray:
        """Read the source image [S, S, 3] of a pair, or sum it if it is not stored."""
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return read_image(path).pixels
        return sum_sources(self.dataset, [pair])[0].permute(1, 2, 0).float().numpy()

    def light(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """Return the true light of a pair's source: camera-space directions [L, 3] and rgb weights [L, 3]."""
        directions = self.header(pair.source_camera).directions
        pairs, weights = load_pairs(self.dataset)[self.name]
        return directions, np.array(weights[pairs.index(pair)])

    @property
    def facts(self) -> dict[str, str | float]:
        """Class and ITA of the skin tone, if the capture contains them."""
        ita = self._skin("ita_deg")
        return {"tone": "unknown"} if ita is None else {"tone": tone_of(ita), "ita_deg": ita}

    @property
    def albedo(self) -> np.ndarray | None:
        """True mean albedo [3] of the bare skin, linear Rec.709; None if unknown."""
        melanin, blood = self._skin("melanin"), self._skin("haemoglobin")
        if melanin is None or blood is None:
            return None
        mixed = skin_albedo(torch.full((1, 1, 1, 1), melanin), torch.full((1, 1, 1, 1), blood))
        return mixed[0, :, 0, 0].numpy()

    def _skin(self, trait: str) -> float | None:
        """Return a skin parameter of the capture; None if it is missing or the face has random colours."""
        traits = self.dataset.entries[self.name].traits
        value = traits.get(trait)
        if not isinstance(value, int | float) or traits.get("random_texture"):
            return None
        return float(value)


Compare = Callable[[Sequence[ComparedFace], Bench], Iterable[Comparison]]


@dataclass(frozen=True)
class PhotoFaces:
    """Photo whose faces are compared one by one, or two photos of a person, compared with each other."""

    items: tuple[Item, ...]
    person: str = ""

    def compared(self, compare: Compare, bench: Bench) -> Iterator[Comparison]:
        for faces in zip(*(self.faces(item, bench) for item in self.items), strict=False):
            yield from compare(faces, bench)

    def faces(self, item: Item, bench: Bench) -> Iterator[ComparedFace]:
        assert bench.photo is not None
        image = read_photo(item, bench.photo)
        for face in fit_faces(item, image, bench.photo):
            case = case_of(f"{item.name}{face.tag}", bench.described)
            facts = {"quality": face.fit.quality, **case.facts}
            case = replace(case, person=self.person or case.person, facts=facts)
            yield ComparedFace(str(item.input_path), case, image, face.found, bench)


def _name(pair: Pair) -> str:
    return f"{pair.subject}/{pair.index:05d}"


@cache
def bench_of(options: EvaluateOptions, photo: PhotoOptions) -> Bench:
    """Load what the comparisons of a run share, once per process.

    By default, faces are fitted as the first checkpoint's networks were trained.
    """
    models, methods = load_models_once(photo), methods_of(options, photo)
    geometry = None if options.joint_fit else photo.geometry or models.default_geometry
    mean = _load(options.mean_checkpoint, photo) if options.mean_checkpoint else None
    described = {} if options.facts is None else read_facts(options.facts)
    sides = models.sides(photo.texture_side)
    return Bench(models, sides, geometry, options.keep_eyes, methods, mean, photo, described)


def methods_of(options: EvaluateOptions, photo: PhotoOptions) -> list[Method]:
    """Load the methods, in the order of `EvaluateOptions.names`."""
    models, features = load_models_once(photo), None
    if options.refine == "features":
        light = LightOptions(photo=photo, vgg_weights=options.measures.vgg_weights)
        features = feature_network(light)[0]
    estimator = Estimator(options.non_negative, features)
    make = partial(Method, network_alone=options.network_alone, estimator=estimator)
    methods = [make(kind, kind, models) for kind in options.reflectance]
    for checkpoint in options.against:
        other = _load(checkpoint.path, photo)
        other.networks.load(("reflectance",))  # errors appear before anything is measured
        methods.append(make(checkpoint.name, "field", other))
    return methods


def _load(path: Path, photo: PhotoOptions) -> Models:
    return load_models((checkpoint_file(path),), photo.face_model, load_models_once(photo).device, photo.form)


def networks_used(options: EvaluateOptions) -> Collection[str]:
    """Return the names of the networks that a run uses."""
    if not options.renders:
        return {"parsing"} if options.measures.face_distance or options.dataset else ()
    refined = options.refine == "features" and options.measures.vgg_weights is None
    return networks_of(options.reflectance) | ({"light_features"} if refined else set())
