"""The items of each protocol of `facerf evaluate`: people of a dataset, photos, and folders of images."""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items, expand_inputs
from facerf_cli.batch.settings import NOT_IN_RECIPE, Settings
from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, pairs_path, read_pairs
from facerf_cli.errors import UsageError
from facerf_cli.evaluation import folder_name
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.olat import TABLE_1, TABLE_3, compare_olats
from facerf_cli.evaluation.pairs import ImagePair, collect_pairs, compare_pair
from facerf_cli.evaluation.people import (
    Compare,
    DatasetPerson,
    Method,
    Portrait,
    SourceFace,
    compare_people,
    evenly,
)
from facerf_cli.evaluation.reconstruction import (
    FULL,
    MEAN,
    TABLE_2_RECONSTRUCTION,
    TABLE_4,
    compare_geometries,
    reconstruct,
)
from facerf_cli.evaluation.summary import Layout
from facerf_cli.evaluation.transfer import TABLE_2_TRANSFER, couples_of, transfer
from facerf_cli.evaluation.yale_b import compare_subject, layout
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.files import checkpoint_file
from facerf_cli.pipeline import Estimator
from facerf_cli.relighting.models import load_models
from facerf_cli.work.evaluate import run_protocol
from facerf_cli.work.evaluation_settings import EvaluateOptions, PairsOptions, SplitOptions, YaleOptions
from facerf_cli.work.light_of_photo import feature_network
from facerf_cli.work.photo_options import LightOptions, PhotoOptions, Refine, networks_of
from facerf_cli.work.photos import fit_faces, load_models_once, prepare_photos, read_photo

Protocol = Literal["olat", "reconstruction", "transfer", "geometry", "yale-b"]
Groups = Mapping[str, Sequence[Sequence[Pair]]]  # by person: pairs whose sources are compared together

# The paper's numbers of images ('Quantitative Evaluations', Tables 2 and 4).
_PAPER_MAPS, _PAPER_SAME, _PAPER_DIFFERENT = 160, 3900, 8100
_PAPER_PHOTOS, _PAPER_COUPLES = 130, 43
_PARTS = 64  # most items of `pairs`


@dataclass(frozen=True)
class FaceSettings:
    """The settings of a protocol on faces; `network_alone` leaves the photo's correction out of the field."""

    protocol: Protocol
    options: EvaluateOptions
    photo: PhotoOptions
    data: SplitOptions = field(default_factory=SplitOptions)
    network_alone: bool = True
    non_negative: bool = True
    refine: Refine = "none"
    mean_checkpoint: Path | None = None

    def methods(self) -> tuple[Method, ...]:
        """The methods, in the order of their names, once a process."""
        options = self.options
        refined = self.refine == "features"
        weights = options.vgg_weights if refined else None
        return _methods(self.photo, options.kinds, options.checkpoints, self.non_negative, refined, weights)

    def prepare(self) -> None:
        """Load what all items need; raises UsageError or InputError for what would fail each."""
        uses = networks_of(self.options.kinds)
        if self.refine == "features" and self.options.vgg_weights is None:
            uses |= {"light_features"}
        prepare_photos(self.photo, uses, with_networks=not self.options.dry_run)
        if not self.options.dry_run:
            self.methods()
            if self.protocol == "geometry":
                mean_methods(self)

    def run(self, tables: Layout, items: Sequence[Item], work: Callable[[Item], Iterator[Comparison]]) -> int:
        """Measure items; the exit code."""
        return run_protocol(tables, items, work, self.options, self.photo.settings, self.photo, self.prepare)


@cache
def _methods(
    photo: PhotoOptions,
    kinds: tuple[RelightKind, ...],
    checkpoints: tuple[Path, ...],
    non_negative: bool,
    refined: bool,
    vgg_weights: str | None,
) -> tuple[Method, ...]:
    models = load_models_once(photo)
    features = feature_network(LightOptions(photo=photo, vgg_weights=vgg_weights))[0] if refined else None
    estimator = Estimator(non_negative, features)
    others = [
        (path.stem, load_models((checkpoint_file(path),), photo.face_model, models.device))
        for path in checkpoints
    ]
    return (
        *(Method(kind, kind, models, estimator) for kind in kinds),
        *(Method(name, "field", other, estimator) for name, other in others),
    )


def mean_methods(settings: FaceSettings) -> tuple[Method, ...]:
    """The methods over a face model whose shapes do nothing, once a process."""
    return _mean_methods(settings.methods(), settings.mean_checkpoint, settings.photo.face_model)


@cache
def _mean_methods(
    methods: tuple[Method, ...], checkpoint: Path | None, face_model: str
) -> tuple[Method, ...]:
    found = []
    for method in methods:
        models = method.models
        if checkpoint is not None and method.kind == "field":
            models = load_models((checkpoint_file(checkpoint),), face_model, models.device)
        found.append(replace(method, models=replace(models, face=models.face.pose_only())))
    return tuple(found)


def run_on_people(settings: FaceSettings, folder: Path) -> int:
    """Measure a split of a prepared dataset; the exit code."""
    dataset, pairs = _read_split(settings, folder)
    groups = _choose(settings, folder, pairs)
    cases = settings.options.output / "cases"
    items = [Item(folder / "olat" / name, cases / name, name) for name in sorted(groups)]
    work = FaceWork(settings, (folder / "dataset.json", pairs_path(dataset)), dataset, groups)
    return settings.run(_tables(settings, sum(map(len, groups.values()))), items, work)


def run_on_photos(settings: FaceSettings, inputs: Sequence[str]) -> int:
    """Measure photos, for transfer couples of them; the exit code."""
    options = settings.options
    if settings.protocol == "transfer":
        couples = _preset_couples(_couples(inputs, options.output), options)
        files = tuple(couple.second.input_path for couple in couples.values())
        work = FaceWork(settings, files, couples=couples)
        return settings.run(_tables(settings, None), list(couples), work)
    items = collect_items(inputs, options.output, PHOTO_SUFFIXES)
    if options.preset and len(items) < _PAPER_PHOTOS:
        raise UsageError(
            f"{len(items)} photos, --preset paper measures {_PAPER_PHOTOS}; give a folder of more"
        )
    chosen = items[:_PAPER_PHOTOS] if options.preset else items
    return settings.run(_tables(settings, None), chosen, FaceWork(settings))


@dataclass(frozen=True, eq=False)
class _Couple:
    """Two photos of a person."""

    person: str
    first: Item
    second: Item

    @property
    def item(self) -> Item:
        """The couple as an item at the first one's place, with both names."""
        tail = f"--{Path(self.second.name).name}"
        return Item(
            self.first.input_path, Path(f"{self.first.output_base}{tail}"), f"{self.first.name}{tail}"
        )


@dataclass(frozen=True, eq=False)
class FaceWork:
    """Compares the faces of an item: a person of the dataset, a couple of photos, or a photo."""

    settings: FaceSettings
    files: tuple[Path, ...] = ()  # that shape the figures beside the items
    dataset: Dataset | None = field(default=None, metadata=NOT_IN_RECIPE)
    groups: Groups = field(default_factory=dict, metadata=NOT_IN_RECIPE)
    couples: Mapping[Item, _Couple] = field(default_factory=dict, metadata=NOT_IN_RECIPE)

    def __call__(self, item: Item) -> Iterator[Comparison]:
        """Yield the comparisons of an item."""
        compare = self._compare()
        if self.dataset is not None:
            yield from compare_people(self._person(item.name, self.dataset), self.groups[item.name], compare)
        elif item in self.couples:
            couple = self.couples[item]
            faces = [next(faces_of(photo, self.settings)) for photo in (couple.first, couple.second)]
            yield from compare(
                [replace(face, case=replace(face.case, person=couple.person)) for face in faces]
            )
        else:
            for face in faces_of(item, self.settings):
                yield from compare([face])

    def _compare(self) -> Compare:
        """The protocol's comparison of faces."""
        settings, methods = self.settings, self.settings.methods()
        if settings.protocol == "olat":
            return partial(compare_olats, methods=methods, network_alone=settings.network_alone)
        if settings.protocol == "reconstruction":
            return partial(reconstruct, methods=methods)
        if settings.protocol == "transfer":
            return partial(transfer, methods=methods, network_alone=settings.network_alone)
        return partial(compare_geometries, forms={FULL: methods, MEAN: mean_methods(settings)})

    def _person(self, name: str, dataset: Dataset) -> DatasetPerson:
        """A person, fitted as the options say, by default as the first method's networks expect."""
        models, photo = self.settings.methods()[0].models, self.settings.photo
        geometry = None if self.settings.data.joint_fit else photo.geometry or models.default_geometry
        sides = models.sides(photo.texture_side)
        people, keep_eyes = models.networks.people, self.settings.options.keep_eyes
        return DatasetPerson(dataset, name, geometry, sides, people, keep_eyes, photo.landmarks_from)


def faces_of(item: Item, settings: FaceSettings) -> Iterator[SourceFace]:
    """Yield the chosen faces of a photo; each counts as a person."""
    photo, models = settings.photo, settings.methods()[0].models
    image, sides = read_photo(item, photo), models.sides(photo.texture_side)
    for face in fit_faces(item, image, photo):
        name = f"{item.name}{face.tag}"
        portrait = Portrait(str(item.input_path), image, face.found, sides, settings.options.keep_eyes)
        portrait.by(models)
        yield SourceFace(Case(name, name, {"quality": face.fit.quality}), portrait)


def _tables(settings: FaceSettings, chosen: int | None) -> Layout:
    """The tables of a protocol; `chosen` counts the images or couples of a dataset, None are photos."""
    alone = settings.network_alone
    light = f"The field's light is estimated by {_squares(settings)}."
    of_set = () if chosen is None else (_note_of_chosen(chosen, settings.data.joint_fit),)
    tone = () if chosen is None else ("tone",)
    if settings.protocol == "olat":
        field_is = "the network alone" if alone else "corrected by its source image"
        clipped = (
            "si_mse_clipped clips the truth at white, as a camera does; otherwise a glint outweighs a face."
        )
        return Layout(
            name="olat",
            title="Single lights of held-out people",
            metrics=("si_mse", "si_mse_clipped", "ssim", "tone_drift_deg"),
            by=("pose", "turn", "angle", "tone"),
            published=TABLE_1 + (TABLE_3 if settings.options.against else ()),
            notes=(
                f"Split {settings.data.split}. The field is {field_is}.",
                *of_set,
                clipped,
                "tone_drift_deg is of the skin under lights within 25 degrees of the camera's axis.",
            ),
        )
    if settings.protocol == "reconstruction":
        return Layout(
            name="reconstruction",
            title="Photos explained and rendered again",
            metrics=("si_mse", "face_distance", "ssim", *(("light_error_deg",) if of_set else ())),
            by=tone,
            published=TABLE_2_RECONSTRUCTION,
            notes=(
                "The field is the network's own: corrected by the photo it would be exact by construction.",
                light,
                *(of_set or ("Each photo counts as a person.",)),
            ),
        )
    if settings.protocol == "transfer":
        field_is = "the network alone" if alone else "corrected by the photo that it is read from"
        mouths = "Where expressions differ, mouths differ, which no reflectance describes."
        red = "one photo cannot separate red light from red skin"
        return Layout(
            name="transfer",
            title="Reflectances of two images of a person exchanged",
            metrics=("si_mse", "face_distance", "si_mse_channels", "ssim"),
            by=("turn", *tone),
            published=TABLE_2_TRANSFER,
            notes=(
                f"The field is {field_is}.",
                f"si_mse_channels fits a scale for each channel: {red}.",
                *(() if of_set else (mouths,)),
                light,
                *of_set,
            ),
        )
    mean = settings.mean_checkpoint
    trained = mean.stem if mean else "the same network, trained on fitted faces only"
    return Layout(
        name="geometry",
        title="The fitted face and the mean face in its pose",
        metrics=("si_mse", "face_distance", "ssim"),
        by=tone,
        published=TABLE_4,
        notes=(f"The mean face is rendered by {trained}; both are compared where both show the face.",),
    )


def _squares(settings: FaceSettings) -> str:
    squares = "non-negative, smooth least squares" if settings.non_negative else "signed least squares"
    return squares if settings.refine == "none" else f"{squares}, refined by features"


def _note_of_chosen(count: int, joint_fit: bool) -> str:
    """Note on the number of sources or couples: those without a face are missing in the tables."""
    if joint_fit:
        return f"{count} were chosen; heads are those fitted to all cameras of a person at once."
    return f"{count} were chosen; those in which no face is found are left out. Each image is fitted alone."


def _read_split(settings: FaceSettings, folder: Path) -> tuple[Dataset, dict[str, list[Pair]]]:
    """A dataset and a split's pairs by person.

    Raises UsageError if there are none, or for the joint fit of another face model.
    """
    dataset, split = read_dataset(folder), settings.data.split
    if settings.data.joint_fit and load_face_model(settings.photo.face_model).name != dataset.face_model:
        raise UsageError(f"--joint-fit: {folder} has fits of {dataset.face_model}; give it as --face-model")
    pairs: dict[str, list[Pair]] = {}
    for pair in read_pairs(dataset):
        if split in ("all", pair.split):
            pairs.setdefault(pair.subject, []).append(pair)
    if not pairs:
        raise UsageError(
            f"{folder}: no pairs in the split {split}; run facerf relight-dataset, or give another --split"
        )
    return dataset, pairs


def _choose(settings: FaceSettings, folder: Path, pairs: Mapping[str, Sequence[Pair]]) -> Groups:
    """The pairs that are compared, each alone or in couples: every Nth, or a preset's number."""
    preset, every = settings.options.preset, settings.data.every
    if settings.protocol == "transfer":
        return _chosen_couples(folder, pairs, bool(preset), every)
    if not preset:
        numbered = [pair for members in pairs.values() for pair in members][::every]
        chosen = {name: [pair for pair in numbered if pair.subject == name] for name in pairs}
    elif settings.protocol == "olat":
        chosen = _paper_pairs(folder, pairs)
    else:
        count = sum(map(len, pairs.values()))
        _require_enough(count, _PAPER_PHOTOS, "sources", folder, _PAPER_PHOTOS / len(pairs))
        chosen = evenly(pairs, _PAPER_PHOTOS)
    return {name: [(pair,) for pair in members] for name, members in chosen.items() if members}


def _paper_pairs(folder: Path, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, list[Pair]]:
    """Choose as many pairs as the paper measured, evenly over people and under its number of maps."""
    maps = dict.fromkeys(pair.envmap for of_subject in pairs.values() for pair in of_subject)
    per_subject = 2 * _PAPER_DIFFERENT / len(pairs)  # half of the pairs change the camera
    _require_enough(len(maps), _PAPER_MAPS, "maps", folder, per_subject)
    kept = set(list(maps)[:_PAPER_MAPS])
    chosen: dict[str, list[Pair]] = {}
    for same, most in ((True, _PAPER_SAME), (False, _PAPER_DIFFERENT)):
        groups = {
            name: [p for p in members if p.envmap in kept and (p.source_camera == p.target_camera) is same]
            for name, members in pairs.items()
        }
        found = evenly(groups, most)
        kind = "pairs of the same pose" if same else "pairs of different poses"
        _require_enough(sum(map(len, found.values())), most, kind, folder, per_subject)
        for name, members in found.items():
            chosen[name] = sorted([*chosen.get(name, []), *members], key=lambda pair: pair.index)
    return chosen


def _chosen_couples(folder: Path, pairs: Mapping[str, Sequence[Pair]], preset: bool, every: int) -> Groups:
    """Choose every Nth couple of a person, or the preset's number evenly over people."""
    couples = {name: couples_of(members) for name, members in pairs.items()}
    if preset:
        most = 2 * _PAPER_COUPLES
        count = 2 * sum(map(len, couples.values()))
        _require_enough(count, most, "images in couples", folder, most / len(pairs))
        return evenly(couples, _PAPER_COUPLES)
    chosen = {name: members[::every] for name, members in couples.items() if members}
    if not chosen:
        raise UsageError(
            f"{folder}: no two sources of one person with different cameras and maps; run relight-dataset "
            "with more"
        )
    return chosen


def _require_enough(found: int, needed: int, what: str, dataset: Path, per_subject: float) -> None:
    """Raise UsageError where a preset needs more than a split has; `per_subject` pairs are enough."""
    if found >= needed:
        return
    raise UsageError(
        f"{dataset}: the split has {found} {what}, --preset paper measures {needed}; run facerf "
        f"relight-dataset {dataset} --envmaps procedural:160 --per-subject {math.ceil(1.1 * per_subject)} "
        "--overwrite always, or prepare more people"
    )


def _couples(inputs: Sequence[str], output: Path) -> dict[Item, _Couple]:
    """An item for each couple: two files each as they are named, and two each of a folder in its order."""
    inputs = list(expand_inputs(inputs))
    items = collect_items(inputs, output, PHOTO_SUFFIXES)
    by_path = {os.path.abspath(item.input_path): item for item in items}
    named = [by_path[os.path.abspath(name)] for name in inputs if not os.path.isdir(name)]
    groups: dict[Path | None, list[Item]] = {None: named}
    for item in items:
        if item not in named:
            groups.setdefault(item.input_path.parent, []).append(item)
    couples: dict[Item, _Couple] = {}
    given: set[frozenset[Path]] = set()
    advice = "give two of each person, A B A B ..., or a folder for each person"
    for folder, members in groups.items():
        if len(members) % 2:
            raise UsageError(
                f"{folder or members[-1].input_path}: {len(members)} photos, an odd number; {advice}"
            )
        for first, second in zip(members[::2], members[1::2], strict=True):
            files = frozenset(item.input_path.resolve() for item in (first, second))
            if len(files) < 2 or files in given:
                raise UsageError(f"{first.input_path} and {second.input_path}: given twice; {advice}")
            given.add(files)
            place = Path(first.name).parent.as_posix()
            of_folder = folder.resolve().name if folder and place == "." else place
            couple = _Couple(of_folder if folder else first.name, first, second)
            couples[couple.item] = couple
    return couples


def _preset_couples(couples: dict[Item, _Couple], options: EvaluateOptions) -> dict[Item, _Couple]:
    """Choose all couples, or a preset's number evenly over people."""
    if not options.preset:
        return couples
    if len(couples) < _PAPER_COUPLES:
        raise UsageError(
            f"{2 * len(couples)} photos in couples, --preset paper measures {2 * _PAPER_COUPLES}; give more"
        )
    groups: dict[str, list[Item]] = {}
    for item, couple in couples.items():
        groups.setdefault(couple.person, []).append(item)
    chosen = evenly(groups, _PAPER_COUPLES)
    return {item: couples[item] for members in chosen.values() for item in members}


def run_yale_b(
    folder: Path, options: EvaluateOptions, photo: PhotoOptions, yale: YaleOptions, network_alone: bool
) -> int:
    """Measure the subjects of Extended Yale B, all if none are named; the exit code.

    Args:
        folder: The database.
        options: The shared options.
        photo: How faces are found and fitted.
        yale: The images that are measured.
        network_alone: True to leave the photo's correction out of the field.
    """
    database = read_yale_b(folder, None if yale.shifts is None else read_shifts(yale.shifts))
    chosen = _chosen(database, yale.subjects or ())
    settings = FaceSettings("yale-b", options, photo, network_alone=network_alone)
    items = [Item(folder / name, options.output / "cases" / name, name) for name in chosen]
    work = YaleWork(settings, yale, database)
    return settings.run(layout(database, chosen, network_alone, yale.room), items, work)


def _chosen(database: YaleB, given: Sequence[str]) -> list[str]:
    """The chosen subjects; raises UsageError for one that is not in the database."""
    wanted = {name.strip() for entry in given for name in entry.split(",") if name.strip()}
    if unknown := sorted(wanted - set(database.subjects)):
        there = ", ".join(database.subjects)
        raise UsageError(f"--subjects {', '.join(unknown)}: not in {database.folder}; give some of {there}")
    return [name for name in database.subjects if not wanted or name in wanted]


@dataclass(frozen=True, eq=False)
class YaleWork:
    """Compares one subject's cases."""

    settings: FaceSettings
    yale: YaleOptions
    database: YaleB = field(metadata=NOT_IN_RECIPE)

    def __call__(self, item: Item) -> Iterator[Comparison]:
        """Yield the comparisons of a subject."""
        methods, photo = self.settings.methods(), self.settings.photo
        models = methods[0].models
        return compare_subject(
            self.database,
            item.name,
            methods,
            models.networks.people,
            self.settings.network_alone,
            photo.geometry or models.default_geometry,
            photo.landmarks_from,
            self.yale.room,
        )


def run_pairs(
    predictions: Sequence[Path], compared: PairsOptions, options: EvaluateOptions, settings: Settings
) -> int:
    """Measure folders of predictions against a folder of truths; the exit code."""
    truth = compared.truth
    pairs = collect_pairs(predictions, truth, compared.masks, compared.facts)
    by = dict.fromkeys(n for pair in pairs for n, value in pair.facts.items() if isinstance(value, str))
    asked = {"lpips": options.vgg_weights is not None, "face_distance": compared.face_distance}
    metrics = ("si_mse", "mse", "psnr", "ssim", *(name for name, wanted in asked.items() if wanted))
    tables = Layout("pairs", f"Predictions against {folder_name(truth)}", metrics, tuple(by))
    size = math.ceil(len(pairs) / _PARTS)
    starts = range(0, len(pairs), size)
    items = [Item(truth, options.output / f"part-{n:02d}", f"part-{n:02d}") for n, _ in enumerate(starts)]
    parts = {item.name: tuple(pairs[start : start + size]) for item, start in zip(items, starts, strict=True)}
    names = tuple(map(folder_name, predictions))
    work = PairsWork(names, tuple(predictions), compared, settings, parts)
    return run_protocol(tables, items, work, options, settings)


@dataclass(frozen=True)
class PairsWork:
    """Reads an item's pairs."""

    names: tuple[str, ...]
    predictions: tuple[Path, ...]
    compared: PairsOptions
    settings: Settings
    parts: Mapping[str, tuple[ImagePair, ...]] = field(metadata=NOT_IN_RECIPE)

    def __call__(self, item: Item) -> Iterator[Comparison]:
        """Yield the comparisons of a part of the pairs."""
        models = load_models_once(PhotoOptions(self.settings)) if self.compared.face_distance else None
        for pair in self.parts[item.name]:
            yield compare_pair(pair, models.networks.people if models else None)
