"""Faces that protocols measure, and the methods that relight them: people of a dataset, and photos."""

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
from facerf_cli.dataset.pairs import Pair, image_path, load_pairs, pair_weights, render_source, weights_path
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
from facerf_cli.portrait.find import Face, NoFaceError, find_faces
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture
from facerf_cli.relighting.fitted import FittedPerson, Target
from facerf_cli.relighting.heads import head_of
from facerf_cli.relighting.models import Models, Sides, load_models
from facerf_cli.relighting.photo_light import DEFAULT_ESTIMATOR, Estimator, estimate_light
from facerf_cli.relighting.reflectance import reflectance_of
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.estimate_light import feature_network
from facerf_cli.work.photo_options import LightOptions, PhotoOptions, networks_of
from facerf_cli.work.photos import fit_faces, load_models_once, read_photo

_MASK_SIDE = 256  # texels of the masks
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Method:
    """A reflectance model under the name of its figures; its images are those of `facerf relight`.

    Without `network_alone` a field is corrected by its photo, which then comes back by construction.
    """

    name: str
    kind: RelightKind
    models: Models
    network_alone: bool = True
    estimator: Estimator = DEFAULT_ESTIMATOR

    def explained(self, head: Head) -> Explained:
        """Reflectance and light of a head's photo."""
        if self.kind == "portrait":
            raise UsageError("--reflectance portrait: is measured on whole photos; use evaluate yale-b")
        if self.kind != "field":
            return explain_by_baseline(self.models, head, self.kind)
        light = estimate_light(self.models, head, estimator=self.estimator).light
        return Explained(reflectance_of(self.models, head, self.kind, self.network_alone), light)

    def image(
        self, head: Head, reflectance: Reflectance, light: RigLight, fit: FaceFit | None = None
    ) -> np.ndarray:
        """The face alone [S, S, 3] under one light, in the pose and the crop of a fit, else in its own."""
        return FittedPerson(self.models, None, head, reflectance).image(light, Target(fit, "face"))

    def images(
        self, photo: np.ndarray | None, head: Head, lights: Light, target: Target
    ) -> Iterator[np.ndarray]:
        """Yield an image under each weighted sum of lights; in the photo, if it is given."""
        reflectance = reflectance_of(self.models, head, self.kind, self.network_alone, photo=photo)
        composition = FittedPerson(self.models, photo, head, reflectance).composed(target)
        for relit in composition.relit(lights):
            yield composition.image(relit)


@dataclass(frozen=True, eq=False)
class Bench:
    """The means of a run: its methods, and how faces are found, fitted and compared.

    Each image is a separate photo, whose face is found, and fitted or regressed as `geometry` says. With
    `geometry` None heads are those that were fitted to all calibrated cameras of a person at once. Eyes are
    left out unless `keep_eyes`, since the field of open eyes is not learnt (paper, 'Results'). `mean` has the
    networks that were trained with the mean face.
    """

    models: Models
    sides: Sides
    geometry: Geometry | None = None
    keep_eyes: bool = False
    methods: Sequence[Method] = ()
    mean: Models | None = None
    photo: PhotoOptions | None = None  # of photos, not of a dataset
    described: Mapping[str, Case] = field(default_factory=dict)  # the rows of --facts

    def find(self, image: np.ndarray, name: str) -> Face:
        """The largest face in an image; InputError where none is found."""
        return find_faces(self.models.networks.people, image, name)[0]

    def heads(self, photo: np.ndarray, face: Face) -> Iterator[tuple[Method, Head]]:
        """Yield each method with its head of a face; methods over the same networks share the fit."""
        heads: dict[int, Head] = {}
        for method in self.methods:
            key = id(method.models)
            if key not in heads:
                heads[key] = head_of(method.models, photo, face, self.geometry)
            yield method, heads[key]


@dataclass(frozen=True, eq=False)
class HeadView:
    """A head in its crop [S, S], in its photo's pose or in that of `fit`, and where it is compared.

    `uv` holds the (u, v) of each pixel. `mask` [S, S] in 0..1 is the paper's M_t where the crop shows the
    photo.
    """

    head: Head
    fit: FaceFit
    uv: Tensor
    mask: np.ndarray

    @property
    def face(self) -> tuple[np.ndarray, np.ndarray]:
        """Mask [S, S] and landmarks [68, 2] of the face in the head's crop."""
        return self.mask, self.head.landmarks_px

    def region(self, name: str) -> np.ndarray:
        """The mask [S, S] in 0..1 of a named region of the face (`face/topology.py`)."""
        return sample_texture(region_mask(name, _MASK_SIDE)[None], self.uv)[..., 0].numpy()


@dataclass(frozen=True, eq=False)
class Portrait:
    """One face of a photo; every method's models fit or regress its head, in one crop.

    `face` is the face as it was found, or a fit that was made beforehand. The photo's alpha tells what is
    neither compared nor used. `name` is the photo's in errors. Of a dataset there are its person and the pair
    whose source it is, too.
    """

    name: str
    case: Case
    photo: LinearImage
    face: Face | FaceFit
    bench: Bench
    origin: "tuple[DatasetPerson, Pair] | None" = None
    _views: dict[int, tuple[Models, HeadView]] = field(default_factory=dict)

    def by(self, models: Models) -> HeadView:
        """The portrait by a method's models; InputError where nothing of the face is visible."""
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
        """Another portrait's head in this portrait's pose."""
        own = self.by(models).fit
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
            raise InputError(
                f"{self.name}: nothing of the fitted face is visible in the image; give its --landmarks"
            )
        return HeadView(head, fit, uv, inside)

    def _inside(self, crop: Crop) -> np.ndarray:
        """The share of the photo in each pixel of a crop [S, S], in 0..1."""
        alpha = self.photo.alpha
        inside = crop.valid(*self.photo.pixels.shape[:2]).astype(np.float32)
        return inside if alpha is None else inside * crop.apply(alpha[..., None])[..., 0]


def common_mask(views: Iterable[HeadView]) -> np.ndarray:
    """The mask [S, S] inside those of all views."""
    return np.minimum.reduce([view.mask for view in views])


@dataclass(frozen=True, eq=False)
class DatasetPerson:
    """A subject of a prepared dataset, and groups of its pairs, whose sources are compared group by group."""

    dataset: Dataset
    name: str
    bench: Bench | None = None  # until it is compared
    groups: Sequence[Sequence[Pair]] = ()
    _lit: dict[str, Portrait] = field(default_factory=dict)
    _headers: dict[str, StackHeader] = field(default_factory=dict)

    def compared(self, compare: "Compare", bench: Bench) -> Iterator[Comparison]:
        """Compare each group; one in one of whose images no face is found is named and left out.

        Raises UsageError where the joint fits are of another face model.
        """
        if bench.geometry is None and bench.models.face.name != self.dataset.face_model:
            raise UsageError(
                f"{self.dataset.folder}: its joint fits are of {self.dataset.face_model}; give it as "
                "--face-model"
            )
        person = replace(self, bench=bench)
        for pairs in self.groups:
            try:
                found = list(compare([person.portrait(pair) for pair in pairs], bench))
            except NoFaceError as error:
                log.warning("%s: left out (%s)", " and ".join(map(_name, pairs)), error)
            else:
                yield from found

    def portrait(self, pair: Pair) -> Portrait:
        """The face in the source of a pair; NoFaceError where none is found in it."""
        portrait = self._portrait(self.source(pair), pair.source_camera, _name(pair))
        case = replace(portrait.case, facts=self.facts | {"map": pair.envmap})
        return replace(portrait, case=case, origin=(self, pair))

    def lit(self, camera: str) -> Portrait:
        """The person in a camera under all lights: under one light no detector finds a face."""
        if camera not in self._lit:
            image = self.header(camera).source
            self._lit[camera] = self._portrait(image, camera, f"{self.name}/{camera}")
        return self._lit[camera]

    def header(self, camera: str) -> StackHeader:
        """The header of a camera's stack, read once."""
        if camera not in self._headers:
            self._headers[camera] = read_olat_header(self.dataset.stack_path(self.name, camera))
        return self._headers[camera]

    def _portrait(self, image: np.ndarray, camera: str, name: str) -> Portrait:
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
        return Portrait(name, Case(name, self.name), LinearImage(image, header.seen), face, self.bench)

    def source(self, pair: Pair) -> np.ndarray:
        """The source image [S, S, 3] of a pair, read or rendered from its recipe."""
        path = image_path(self.dataset, *pair.key)
        if path.is_file():
            return read_image(path).pixels
        return render_source(self.dataset, pair).permute(1, 2, 0).float().numpy()

    def light(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        """The true light of a pair's source: camera-space directions [L, 3], rgb weights [L, 3]."""
        directions = self.header(pair.source_camera).directions
        # Nothing is written into a dataset that is measured on.
        if not weights_path(self.dataset).is_file():
            return directions, pair_weights(self.dataset, pair).numpy()
        pairs, weights = load_pairs(self.dataset)[self.name]
        return directions, np.array(weights[pairs.index(pair)])

    @property
    def facts(self) -> dict[str, str | float]:
        """The class of their skin tone, if the capture holds it."""
        ita = self._skin("ita_deg")
        return {"tone": "unknown"} if ita is None else {"tone": tone_of(ita), "ita_deg": ita}

    @property
    def albedo(self) -> np.ndarray | None:
        """The true mean albedo [3] of their bare skin, linear Rec.709; None if it is not known."""
        melanin, blood = self._skin("melanin"), self._skin("haemoglobin")
        if melanin is None or blood is None:
            return None
        mixed = skin_albedo(torch.full((1, 1, 1, 1), melanin), torch.full((1, 1, 1, 1), blood))
        return mixed[0, :, 0, 0].numpy()

    def _skin(self, trait: str) -> float | None:
        """A number of their skin in the capture; faces of random colours have none."""
        traits = self.dataset.traits_of(self.name)
        value = traits.get(trait)
        if not isinstance(value, int | float) or traits.get("random_texture"):
            return None
        return float(value)


Compare = Callable[[Sequence[Portrait], Bench], Iterable[Comparison]]


@dataclass(frozen=True)
class PhotoFaces:
    """A photo whose faces are compared one by one, or two of a person whose faces are compared together."""

    items: tuple[Item, ...]
    person: str = ""

    def compared(self, compare: Compare, bench: Bench) -> Iterator[Comparison]:
        """Compare each face, or the faces of both."""
        for faces in zip(*(self.faces(item, bench) for item in self.items), strict=False):
            yield from compare(faces, bench)

    def faces(self, item: Item, bench: Bench) -> Iterator[Portrait]:
        """Yield the chosen faces of a photo."""
        assert bench.photo is not None
        image = read_photo(item, bench.photo)
        for face in fit_faces(item, image, bench.photo):
            case = case_of(f"{item.name}{face.tag}", bench.described)
            facts = {"quality": face.fit.quality, **case.facts}
            case = replace(case, person=self.person or case.person, facts=facts)
            yield Portrait(str(item.input_path), case, image, face.found, bench)


def _name(pair: Pair) -> str:
    return f"{pair.subject}/{pair.index:05d}"


@cache
def bench_of(options: EvaluateOptions, photo: PhotoOptions) -> Bench:
    """The methods, in the order of their names, and how faces are read, once a process.

    Faces are read as the first method's networks expect, where the options do not say.
    """
    models, methods = load_models_once(photo), methods_of(options, photo)
    geometry = None if options.joint_fit else photo.geometry or models.default_geometry
    mean = _load(options.mean_checkpoint, photo) if options.mean_checkpoint else None
    described = {} if options.facts is None else read_facts(options.facts)
    sides = models.sides(photo.texture_side)
    return Bench(models, sides, geometry, options.keep_eyes, methods, mean, photo, described)


def methods_of(options: EvaluateOptions, photo: PhotoOptions) -> list[Method]:
    """The methods, in the order of their names."""
    models, features = load_models_once(photo), None
    if options.refine == "features":
        light = LightOptions(photo=photo, vgg_weights=options.measures.vgg_weights)
        features = feature_network(light)[0]
    estimator = Estimator(options.non_negative, features)
    make = partial(Method, network_alone=options.network_alone, estimator=estimator)
    methods = [make(kind, kind, models) for kind in options.reflectance]
    for one in options.against:
        other = _load(one.path, photo)
        other.networks.load(("reflectance",))  # fails before anything is measured
        methods.append(make(one.name, "field", other))
    return methods


def _load(path: Path, photo: PhotoOptions) -> Models:
    """The models of another checkpoint."""
    return load_models((checkpoint_file(path),), photo.face_model, load_models_once(photo).device, photo.form)


def networks_used(options: EvaluateOptions) -> Collection[str]:
    """Names of the networks that the options of the field's methods use; those of faces always."""
    if not options.ours:
        return {"parsing"} if options.measures.face_distance or options.dataset else ()
    refined = options.refine == "features" and options.measures.vgg_weights is None
    return networks_of(options.reflectance) | ({"light_features"} if refined else set())
