"""The means of a run by its options: methods, how faces are read, and the networks that take part."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from facerf_cli.batch.inputs import Item
from facerf_cli.evaluation.folders import case_of, read_facts
from facerf_cli.evaluation.measure import Case
from facerf_cli.evaluation.options import EvaluateOptions
from facerf_cli.evaluation.people import Bench, Method, Portrait, Reading
from facerf_cli.network.files import checkpoint_file
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.relighting.photo_light import Estimator
from facerf_cli.work.light_of_photo import feature_network
from facerf_cli.work.photo_options import LightOptions, PhotoOptions, networks_of
from facerf_cli.work.photos import fit_faces, load_models_once, read_photo


@cache
def bench_of(options: EvaluateOptions, photo: PhotoOptions) -> Bench:
    """The methods, in the order of their names, and how faces are read, once a process.

    Faces are read as the first method's networks expect, where the options do not say.
    """
    models, methods = load_models_once(photo), methods_of(options, photo)
    geometry = None if options.joint_fit else photo.geometry or models.default_geometry
    reading = Reading(models.networks.people, models.sides(photo.texture_side), geometry, options.keep_eyes)
    mean = _load(options.mean_checkpoint, photo) if options.mean_checkpoint else None
    return Bench(models, reading, methods, mean, partial(_faces_of, options, photo, reading))


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


def _faces_of(
    options: EvaluateOptions, photo: PhotoOptions, reading: Reading, item: Item
) -> Iterator[Portrait]:
    """Yield the chosen faces of a photo."""
    image = read_photo(item, photo)
    for face in fit_faces(item, image, photo):
        case = case_of(f"{item.name}{face.tag}", _described(options.facts))
        case = replace(case, facts={"quality": face.fit.quality, **case.facts})
        yield Portrait(str(item.input_path), case, image, face.found, reading)


@cache
def _described(facts: Path | None) -> Mapping[str, Case]:
    """The rows of --facts by name, once a process."""
    return {} if facts is None else read_facts(facts)


def networks_used(options: EvaluateOptions) -> Collection[str]:
    """Names of the networks that the options of the field's methods use; those of faces always."""
    if not options.ours:
        return {"parsing"} if options.measures.face_distance or options.dataset else ()
    refined = options.refine == "features" and options.measures.vgg_weights is None
    return networks_of(options.reflectance) | ({"light_features"} if refined else set())
