"""The items of each protocol of `facerf evaluate`: people of a dataset, photos, and folders of images."""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.settings import Settings
from facerf_cli.capture.yale_b import YaleB, read_shifts, read_yale_b
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, pairs_path, read_pairs
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation.measure import Comparison
from facerf_cli.evaluation.options import (
    EvaluateOptions,
    PairsOptions,
    YaleOptions,
    folder_name,
    portrait_name,
)
from facerf_cli.evaluation.pairs import Facts, ImagePair, case_of, collect_pairs, compare_pair, read_facts
from facerf_cli.evaluation.people import (
    Compare,
    DatasetPerson,
    Method,
    Portrait,
    Reading,
    SourceFace,
    compare_people,
)
from facerf_cli.evaluation.protocols import (
    COMPOSITE,
    LAMBERT,
    LAYOUTS,
    compare_olats,
    fitted_and_mean,
    reconstruct,
    transfer,
)
from facerf_cli.evaluation.selection import (
    PAIRS_LIST,
    Couple,
    Groups,
    choose_couples,
    choose_olats,
    choose_photos,
    choose_sources,
    couples_of_photos,
    pairs_of_split,
    read_list,
    write_list,
)
from facerf_cli.evaluation.summary import Layout, published
from facerf_cli.evaluation.yale_b import compare_subject, layout
from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.files import checkpoint_file, serving_files, title_of
from facerf_cli.network.stored_graph import ASSET
from facerf_cli.pipeline import Estimator
from facerf_cli.relighting.models import load_models
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.work.evaluate import CompareItem, Evaluation
from facerf_cli.work.evaluation_settings import FaceSettings
from facerf_cli.work.light_of_photo import feature_network
from facerf_cli.work.photo_options import LightOptions, PhotoOptions, SolveOptions, networks_of
from facerf_cli.work.photos import fit_faces, load_models_once, prepare_photos, read_photo

_PARTS = 64  # most items of `pairs`
log = logging.getLogger(LOGGER_NAME)
_MEDIAPIPE = {"networks of MediaPipe": ASSET}
_RED = "one photo cannot separate red light from red skin"


@cache
def methods_of(settings: FaceSettings) -> tuple[Method, ...]:
    """The methods, in the order of their names, once a process."""
    options, photo, solve = settings.options, settings.photo, settings.solve
    models = load_models_once(photo)
    features = None
    if solve.refine == "features":
        vgg_weights = options.measures.vgg_weights
        features = feature_network(LightOptions(photo=photo, vgg_weights=vgg_weights))[0]
    estimator = Estimator(solve.non_negative, features)
    alone = settings.network_alone
    names = {"portrait": portrait_name(photo.settings.checkpoints)}
    others = [
        (one.name, load_models((checkpoint_file(one.path),), photo.face_model, models.device, photo.form))
        for one in options.against
    ]
    for _, other in others:
        other.networks.load(("reflectance",))  # fails before anything is measured
    return (
        *(Method(names.get(kind, kind), kind, models, alone, estimator) for kind in options.reflectance),
        *(Method(name, "field", other, alone, estimator) for name, other in others),
    )


@cache
def mean_methods(settings: FaceSettings) -> tuple[Method, ...]:
    """The methods over a face model whose shapes do nothing, once a process."""
    found = []
    for method in methods_of(settings):
        models, checkpoint = method.models, settings.mean_checkpoint
        if checkpoint is not None and method.kind == "field":
            photo, file = settings.photo, checkpoint_file(checkpoint)
            models = load_models((file,), photo.face_model, models.device, photo.form)
        found.append(replace(method, models=replace(models, face=models.face.pose_only())))
    return tuple(found)


def reading_of(settings: FaceSettings) -> Reading:
    """Settings of reading faces, by default as the first method's networks expect."""
    models, photo = methods_of(settings)[0].models, settings.photo
    geometry = None if settings.data.joint_fit else photo.geometry or models.default_geometry
    sides, keep_eyes = models.sides(photo.texture_side), settings.options.keep_eyes
    return Reading(models.networks.people, sides, geometry, keep_eyes)


def _comparison(settings: FaceSettings) -> Compare:
    """The protocol's comparison of faces."""
    methods = methods_of(settings)
    if settings.protocol == "olat":
        return partial(compare_olats, methods=methods)
    if settings.protocol == "transfer":
        return partial(transfer, methods=methods)
    if settings.protocol == "reconstruction":
        return partial(reconstruct, methods=methods)
    both = fitted_and_mean(methods, mean_methods(settings))
    return partial(reconstruct, methods=both, with_light=False)


def _networks_used(settings: FaceSettings) -> frozenset[str]:
    refined = settings.solve.refine == "features" and settings.options.measures.vgg_weights is None
    return networks_of(settings.options.reflectance) | ({"light_features"} if refined else set())


def _networks_named(settings: FaceSettings) -> dict[str, Path]:
    """The file of each network that takes part, by title; those that one method alone uses name it."""
    options, uses = settings.options, _networks_used(settings)
    files = serving_files(settings.photo.settings.checkpoints)
    named = {title_of(name): path for name, path in files.items() if name in uses}
    others = {one.name: one.path for one in options.against}
    if settings.mean_checkpoint is not None:
        others["the mean face"] = settings.mean_checkpoint
    for method, path in others.items():
        by = serving_files((checkpoint_file(path),))
        own = {name for name in networks_of(("field",)) if by[name] != named.get(title_of(name))}
        named |= {f"{title_of(name)} of {method}": by[name] for name in sorted(own)}
    return named | _MEDIAPIPE


def _prepare(settings: FaceSettings) -> None:
    """Load what all items need; raises UsageError or InputError for what would fail each."""
    prepare_photos(settings.photo, _networks_used(settings), with_networks=not settings.options.dry_run)
    if not settings.options.dry_run:
        methods_of(settings)
        if settings.protocol == "geometry":
            mean_methods(settings)


def _run(
    settings: FaceSettings,
    tables: Layout,
    items: Sequence[Item],
    compare: CompareItem,
    recipe: tuple[Any, ...] = (),
) -> int:
    """Measure items; the exit code. `recipe` has more options that shape the figures."""
    photo = settings.photo
    if settings.options.measures.face_distance:
        tables = replace(tables, metrics=tuple(dict.fromkeys((*tables.metrics, "face_distance"))))
    networks = tuple(_networks_named(settings).items())
    run = Evaluation(tables, compare, (settings, *recipe), settings.options, photo.settings, networks, photo)
    return run.run(items, partial(_prepare, settings))


def run_on_people(settings: FaceSettings, folder: Path) -> int:
    """Measure a split of a prepared dataset; the exit code."""
    dataset, data, options = read_dataset(folder), settings.data, settings.options
    if data.joint_fit and load_face_model(settings.photo.face_model).name != dataset.face_model:
        raise UsageError(f"--joint-fit: {folder} has fits of {dataset.face_model}; give it as --face-model")
    choose = {"olat": choose_olats, "transfer": choose_couples}.get(settings.protocol, choose_sources)
    strangers: frozenset[Pair] = frozenset()
    if data.pairs:
        groups = read_list(data.pairs, dataset, 2 if settings.protocol == "transfer" else 1)
        listed = {pair for members in groups.values() for group in members for pair in group}
        strangers = frozenset(listed.difference(read_pairs(dataset)))
    else:
        groups = choose(pairs_of_split(dataset, data.split), data.every, bool(options.preset))
    if not options.dry_run:
        write_list(options.output / PAIRS_LIST, groups)
    items = [Item(folder / "olat" / name, options.output / "cases" / name, name) for name in sorted(groups)]
    settings = replace(settings, files=(folder / "dataset.json", data.pairs or pairs_path(dataset)))
    tables = _tables(settings, sum(map(len, groups.values())))
    return _run(settings, tables, items, partial(_compare_person, settings, dataset, groups, strangers))


def _compare_person(
    settings: FaceSettings, dataset: Dataset, groups: Groups, strangers: frozenset[Pair], item: Item
) -> Iterator[Comparison]:
    person = DatasetPerson(dataset, item.name, reading_of(settings), strangers)
    return compare_people(person, groups[item.name], _comparison(settings))


def run_on_photos(settings: FaceSettings, inputs: Sequence[str]) -> int:
    """Measure photos; the exit code."""
    items = collect_items(inputs, settings.options.output, PHOTO_SUFFIXES)
    chosen = choose_photos(items, bool(settings.options.preset))
    names = {item.name for item in items}
    if settings.photo.face != "all" and (unknown := sorted(_described(settings.facts).keys() - names)):
        raise InputError(
            f"{settings.facts}: {unknown[0]} is no photo of this run; give names such as {min(names)}"
        )
    return _run(settings, _tables(settings, None), chosen, partial(_compare_photo, settings))


def _compare_photo(settings: FaceSettings, item: Item) -> Iterator[Comparison]:
    for face in faces_of(item, settings):
        yield from _comparison(settings)([face])


def run_on_couples(settings: FaceSettings, inputs: Sequence[str]) -> int:
    """Measure couples of photos; the exit code."""
    options = settings.options
    couples = {c.item: c for c in couples_of_photos(inputs, options.output, bool(options.preset))}
    settings = replace(settings, files=tuple(couple.photos[1].input_path for couple in couples.values()))
    return _run(settings, _tables(settings, None), list(couples), partial(_compare_couple, settings, couples))


def _compare_couple(
    settings: FaceSettings, couples: Mapping[Item, Couple], item: Item
) -> Iterable[Comparison]:
    couple = couples[item]
    faces = [next(faces_of(photo, settings)) for photo in couple.photos]
    return _comparison(settings)(
        [replace(face, case=replace(face.case, person=couple.person)) for face in faces]
    )


def faces_of(item: Item, settings: FaceSettings) -> Iterator[SourceFace]:
    """Yield the chosen faces of a photo."""
    photo, models = settings.photo, methods_of(settings)[0].models
    image, reading = read_photo(item, photo), reading_of(settings)
    for face in fit_faces(item, image, photo):
        name = f"{item.name}{face.tag}"
        portrait = Portrait(str(item.input_path), image, face.found, reading)
        portrait.by(models)
        case = case_of(name, _described(settings.facts))
        yield SourceFace(replace(case, facts={"quality": face.fit.quality, **case.facts}), portrait)


@cache
def _described(facts: Path | None) -> Mapping[str, Facts]:
    """The rows of --facts by name, once a process."""
    return {} if facts is None else read_facts(facts)


def _tables(settings: FaceSettings, chosen: int | None) -> Layout:
    """The tables of a protocol; `chosen` counts the images or couples of a dataset, None are photos."""
    of_ablation = ("olat --against",) if settings.options.against else ()
    return replace(
        LAYOUTS[settings.protocol],
        published=published(settings.protocol, *of_ablation),
        notes=_notes(settings, chosen),
    )


def _notes(settings: FaceSettings, chosen: int | None) -> tuple[str, ...]:
    alone, mean = settings.network_alone, settings.mean_checkpoint
    light = f"The field's light is estimated by {_squares(settings.solve)}."
    of_set = () if chosen is None else (_note_of_chosen(chosen, settings.data.joint_fit),)
    if settings.protocol == "olat":
        return (
            f"Split {settings.data.split}. The field is {_field_is(alone, 'its source image')}.",
            *of_set,
            "si_mse_clipped clips the truth at white, as a camera does; otherwise a glint outweighs a face.",
            f"{LAMBERT} is the source's own texture under the cosine of the light, the least to beat; "
            f"{COMPOSITE} is the first method's image of `facerf relight`, with the photo's detail.",
            "tone_drift_deg is of the skin under lights within 25 degrees of the camera's axis.",
        )
    if settings.protocol == "reconstruction":
        return (
            "The field is the network's own: corrected by the photo it would be exact by construction.",
            light,
            *of_set,
        )
    if settings.protocol == "transfer":
        mouths = "Where expressions differ, mouths differ, which no reflectance describes."
        return (
            f"The field is {_field_is(alone, 'the photo that it is read from')}.",
            f"si_mse_channels fits a scale for each channel: {_RED}.",
            *(() if of_set else (mouths,)),
            light,
            *of_set,
        )
    trained = mean.stem if mean else "the same network, trained on fitted faces only"
    return (f"The mean face is rendered by {trained}; both are compared where both show the face.",)


def _field_is(network_alone: bool, corrected_by: str) -> str:
    return "the network alone" if network_alone else f"corrected by {corrected_by}"


def _squares(solve: SolveOptions) -> str:
    squares = "non-negative, smooth least squares" if solve.non_negative else "signed least squares"
    return squares if solve.refine == "none" else f"{squares}, refined by features"


def _note_of_chosen(count: int, joint_fit: bool) -> str:
    """Note on the number of sources or couples: those without a face are missing in the tables."""
    if joint_fit:
        return f"{count} were chosen; heads are those fitted to all cameras of a person at once."
    return f"{count} were chosen; those in which no face is found are left out. Each image is fitted alone."


def run_yale_b(settings: FaceSettings, yale: YaleOptions, folder: Path) -> int:
    """Measure the subjects of Extended Yale B, all if none are named; the exit code."""
    database = read_yale_b(folder, None if yale.shifts is None else read_shifts(yale.shifts))
    chosen = _subjects(database, yale.subjects or ())
    items = [Item(folder / name, settings.options.output / "cases" / name, name) for name in chosen]
    tables = layout(database, chosen, settings.network_alone, yale.room)
    compare = partial(_compare_subject, settings, yale.room, database)
    return _run(settings, tables, items, compare, (yale,))


def _subjects(database: YaleB, given: Sequence[str]) -> list[str]:
    """The chosen subjects; raises UsageError for one that is not in the database."""
    wanted = {name.strip() for entry in given for name in entry.split(",") if name.strip()}
    if unknown := sorted(wanted - set(database.subjects)):
        there = ", ".join(database.subjects)
        raise UsageError(f"--subjects {', '.join(unknown)}: not in {database.folder}; give some of {there}")
    return [name for name in database.subjects if not wanted or name in wanted]


def _compare_subject(
    settings: FaceSettings, room: float, database: YaleB, item: Item
) -> Iterator[Comparison]:
    return compare_subject(database, item.name, methods_of(settings), reading_of(settings), room)


def run_pairs(compared: PairsOptions, options: EvaluateOptions, settings: Settings) -> int:
    """Measure folders of predictions against a folder of truths; the exit code."""
    truth = compared.truth
    pairs = collect_pairs(compared.predictions, truth, compared.masks, compared.facts)
    facts = (fact for pair in pairs for fact in pair.case.facts.items())
    by = dict.fromkeys(name for name, value in facts if isinstance(value, str))
    measures = options.measures
    asked = {"lpips": measures.vgg_weights is not None, "face_distance": measures.face_distance}
    metrics = ("si_mse", "mse", "psnr", "ssim", *(name for name, wanted in asked.items() if wanted))
    tables = Layout("pairs", f"Predictions against {folder_name(truth)}", metrics, tuple(by))
    size = math.ceil(len(pairs) / _PARTS)
    parts = {
        f"part-{n:02d}": pairs[start : start + size] for n, start in enumerate(range(0, len(pairs), size))
    }
    items = [Item(truth, options.output / name, name) for name in parts]
    compare = partial(_compare_part, settings if measures.face_distance else None, parts)
    finders: dict[str, Path] = {}
    if measures.face_distance:
        finders = {title_of("parsing"): serving_files(settings.checkpoints)["parsing"], **_MEDIAPIPE}
    networks = tuple(finders.items())
    return Evaluation(tables, compare, (compared, settings), options, settings, networks).run(items)


def _compare_part(
    finds_by: Settings | None, parts: Mapping[str, Sequence[ImagePair]], item: Item
) -> Iterator[Comparison]:
    """Yield the comparisons of a part of the pairs, with landmarks where faces are found."""
    people = load_models_once(PhotoOptions(finds_by)).networks.people if finds_by else None
    for pair in parts[item.name]:
        yield compare_pair(pair, people)
