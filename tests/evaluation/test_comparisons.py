"""The protocols on a tiny dataset whose truth is known in closed form."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, image_path, load_pairs, read_pairs
from facerf_cli.errors import InputError, UsageError
from facerf_cli.evaluation import comparisons, people
from facerf_cli.evaluation.comparisons import (
    COMPOSITE,
    FULL,
    LAMBERT,
    LIGHTS_DEG,
    MEAN,
    angle_class,
    angle_of,
    brightest,
    compare_olats,
    freeze,
    reconstruct,
    reconstruct_with_mean,
    rendered,
    transfer,
    turn_class,
)
from facerf_cli.evaluation.measure import Case, Comparison
from facerf_cli.evaluation.metrics import si_mse
from facerf_cli.evaluation.options import FaceOptions
from facerf_cli.evaluation.people import Bench, DatasetPerson
from facerf_cli.evaluation.selection import couples_of, evenly, olat_pairs
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import FaceFit, Geometry, fit_landmarks
from facerf_cli.face.morphable import load_face_model
from facerf_cli.files.olat_stack import read_olats
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.main import main
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.models import Sides
from tests.dataset.dataset_fixture import write_small_dataset
from tests.evaluation.method_doubles import BRIGHTEST, Double, FaceModelOnly, PersonOfAlbedo
from tests.kinds import Folders, Log, Patch
from tests.refusals import refused


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: Folders) -> Dataset:
    return write_small_dataset(tmp_path_factory.mktemp("dataset"), counts=(0, 0, 1), lights=30, crop_px=96)


@pytest.fixture(scope="module")
def person(dataset: Dataset) -> DatasetPerson:
    return person_of(dataset)


def person_of(dataset: Dataset, geometry: Geometry | None = None) -> PersonOfAlbedo:
    """Of the joint fit, which is the true one here, unless another geometry is given."""
    return PersonOfAlbedo(dataset, "0000", reading(geometry))


def reading(geometry: Geometry | None = None, crop_px: int = 96) -> Bench:
    return Bench(FACE_ONLY, Sides(128, crop_px), geometry)  # type: ignore[arg-type]


def pair(index: int, source: str, target: str, light: int, envmap: str = "a") -> Pair:
    return Pair("0000", index, "test", source, envmap, 0.0, 0, target, light)


PAPER = FaceOptions(Path("out"), preset="paper")
FACE_ONLY = FaceModelOnly(load_face_model())


def unlit(gain: float = 1.0, models: FaceModelOnly = FACE_ONLY) -> Double:
    return Double("unlit", models=models, gain=gain)


def olats(person: DatasetPerson, pairs: list[Pair], methods: list[Double]) -> Iterator[Comparison]:
    return replace(person, groups=[(pair,) for pair in pairs]).compared(
        compare_olats, bench(person, *methods)
    )


def bench(person: DatasetPerson, *methods: Double) -> Bench:
    assert person.bench is not None
    return replace(person.bench, methods=methods)


def side_light(person: DatasetPerson, camera: str) -> int:
    """A light from the side that the camera sees."""
    directions = person.header(camera).directions
    return int(np.abs(directions @ np.array([0.7, 0.1, 0.7]) - 1).argmin())


@pytest.mark.parametrize("target", ["C0", "C1"])
def test_lamberts_law_on_true_albedo_is_the_truth_in_any_pose(person: DatasetPerson, target: str) -> None:
    asked = pair(3, "C0", target, side_light(person, target))
    (found,) = olats(person, [asked], [unlit()])
    truth, mask = found.truth, found.mask
    right = si_mse(found.predictions[LAMBERT], truth, mask)
    wrong = si_mse(found.predictions["unlit"], truth, mask)
    composite = [COMPOSITE] if target == "C0" else []
    assert list(found.predictions) == ["unlit", LAMBERT, *composite] and found.case.name == "0000/00003"
    assert right < 0.03 * wrong
    same = target == "C0"
    assert found.case.facts["pose"] == ("same pose" if same else "different pose")
    assert found.case.facts["turn"] == ("none" if same else "30 to 60 deg")  # the cameras are at -15 and 20
    assert found.case.facts["tone"] == "unknown" and not found.extra
    assert found.case.facts["map"] == "a"


def with_traits(dataset: Dataset, traits: dict[str, Any]) -> Dataset:
    entry = dataset.entries["0000"].model_copy(update={"traits": traits})
    return dataset.model_copy(update={"entries": {"0000": entry}})


def test_drift_of_the_tone_is_measured_where_the_skin_is_known(
    person: DatasetPerson, dataset: Dataset
) -> None:
    traits = {"ita_deg": 30.0, "melanin": 0.05, "haemoglobin": 0.02, "random_texture": False}
    known = person_of(with_traits(dataset, traits))
    front = int(known.header("C0").directions[:, 2].argmax())
    asked = [pair(0, "C0", "C0", front), pair(1, "C0", "C0", side_light(known, "C0"))]
    near, aside = olats(known, asked, [unlit()])
    assert near.case.facts["tone"] == "intermediate"
    assert abs(near.extra[LAMBERT]["tone_shift_deg"]) < 1  # it is the truth
    assert near.extra["unlit"]["tone_drift_deg"] == abs(near.extra["unlit"]["tone_shift_deg"])
    assert not aside.extra
    painted = with_traits(dataset, traits | {"random_texture": True})
    assert person_of(painted).facts == {"tone": "unknown"}


def test_a_photo_put_together_from_its_own_texture_is_the_photo(person: DatasetPerson) -> None:
    asked = pair(0, "C0", "C0", 0)
    image = person.source(asked)
    truth = np.eye(3), np.array([[0.0, 0, 0], [5, 5, 5], [1, 1, 1]])
    face = person.source_of(asked)
    assert face.origin is not None
    lit: Any = SimpleNamespace(light=lambda _: truth)
    (found,) = reconstruct([replace(face, origin=(lit, asked))], bench(person, unlit(0.5)))
    error = si_mse(found.predictions["unlit"], image, found.mask)
    assert error < 0.01 * np.square(image[found.mask > 0.5]).mean()
    np.testing.assert_allclose(found.extra["unlit"]["light_error_deg"], 90)
    assert np.array_equal(brightest(*truth), [0, 1, 0]) and BRIGHTEST.tolist() == [0, 0, 1]
    np.testing.assert_allclose(found.landmarks_px, face.fit_with(FACE_ONLY).fit.landmarks_px)


def test_reflectances_change_places_and_lights_stay(person: DatasetPerson) -> None:
    method = unlit()
    sides = []
    for camera in ("C0", "C1"):
        asked = pair(0, camera, camera, 0)
        sides.append(replace(person.source_of(asked), case=Case(f"by {camera}", "0000")))
    first, second = transfer(sides, bench(person, method))
    assert first.case.name == "by C0_by_by C1"
    a, b = method.made
    ((_, light_of_a, turn),) = b.reflectance.asked  # type: ignore[attr-defined]
    assert torch.equal(light_of_a[0], a.light.weights)
    heads = [side.fit_with(FACE_ONLY).head for side in sides]
    fits = [head.fit for head in heads]
    torch.testing.assert_close(turn @ fits[1].rotation, fits[0].rotation)
    assert first.truth is heads[0].cropped and first.source is heads[1].cropped
    assert first.landmarks_px is not None and first.source_face is not None
    assert np.array_equal(first.landmarks_px, heads[0].landmarks_px)
    assert np.array_equal(first.source_face[1], heads[1].landmarks_px)
    assert second.case.facts["turn"] == "30 to 60 deg"
    for found in (first, second):  # the same face in another image: its texture fits where it is visible
        energy = np.square(found.truth[found.mask > 0.5]).mean()
        assert si_mse(found.predictions["unlit"], found.truth, found.mask) < 0.05 * energy


def test_the_mean_face_is_compared_where_both_see_the_face(dataset: Dataset, monkeypatch: Patch) -> None:
    person = found_by_truth(dataset, monkeypatch)
    mean = FaceModelOnly(FACE_ONLY.face.pose_only())
    face = person.source_of(pair(0, "C1", "C1", 0))
    views = [face.fit_with(models) for models in (FACE_ONLY, mean)]
    assert views[0].fit.alpha.any() and not views[1].fit.alpha.any()
    (found,) = reconstruct_with_mean([face], bench(person, unlit()))
    assert list(found.predictions) == [FULL, MEAN]
    assert np.array_equal(found.mask, np.minimum(views[0].mask, views[1].mask))
    (found,) = reconstruct_with_mean([face], bench(person, *(replace(unlit(), name=name) for name in "xy")))
    assert list(found.predictions) == [f"{FULL}, x", f"{FULL}, y", f"{MEAN}, x", f"{MEAN}, y"]


def found_by_truth(dataset: Dataset, monkeypatch: Patch, blind: str = "") -> PersonOfAlbedo:
    """A person in whose images faces are found where they are; in those of the camera `blind` none is."""
    joint = person_of(dataset)
    cameras = {camera: joint.under_all_lights(camera).face for camera in ("C0", "C1")}

    def find(_: object, image: np.ndarray, name: str) -> list[Face]:
        camera = name.rpartition("/")[2]
        if camera not in cameras:  # a source, of C0 if its index is even
            camera = f"C{int(camera) % 2}"
        if camera == blind:
            raise InputError(f"{name}: no face found")
        fit = cameras[camera]
        assert isinstance(fit, FaceFit)
        return [face_at(fit.landmarks_px.double().numpy())]

    monkeypatch.setattr(people, "find_faces", find)
    return person_of(dataset, "landmarks")


def test_each_image_is_a_photo_of_its_own(dataset: Dataset, monkeypatch: Patch) -> None:
    """Its head is fitted to the landmarks that are found in it, in the crop that they give."""
    asked = pair(0, "C0", "C0", 0)
    alone = found_by_truth(dataset, monkeypatch).source_of(asked).fit_with(FACE_ONLY)
    joint = person_of(dataset).source_of(asked).fit_with(FACE_ONLY)
    assert isinstance(joint.head.fit, FaceFit) and joint.head.fit.crop.side_px == 96
    landmarks_px = joint.head.fit.landmarks_px.double().numpy()
    assert alone.head.fit.crop == from_landmarks(landmarks_px, 96)
    assert not torch.equal(alone.head.fit.alpha, joint.head.fit.alpha)
    own = fit_landmarks(FACE_ONLY.face, alone.head.fit.crop.to_crop(landmarks_px), alone.head.fit.crop)
    torch.testing.assert_close(alone.head.fit.alpha, own.alpha, rtol=0, atol=1e-3)


@pytest.mark.parametrize("target", ["C0", "C1"])
def test_monocular_predictions_lie_on_the_truth(dataset: Dataset, monkeypatch: Patch, target: str) -> None:
    person = found_by_truth(dataset, monkeypatch)
    asked = pair(2, "C0", target, side_light(person, target))
    (found,) = olats(person, [asked], [unlit()])
    right = si_mse(found.predictions[LAMBERT], found.truth, found.mask)
    wrong = si_mse(found.predictions["unlit"], found.truth, found.mask)
    assert found.truth.shape == found.predictions["unlit"].shape == (96, 96, 3)
    assert right < 0.2 * wrong  # the fit to landmarks is not the true shape


def assert_almost_all_close(image: np.ndarray, source: np.ndarray) -> None:
    """Highlights, which a relit image gets only a limited detail of, may differ in a few pixels."""
    assert np.quantile(np.abs(image - source), 0.98) < 2e-3


def test_in_its_own_pose_the_composite_is_the_image_of_relight_in_the_crop(
    dataset: Dataset, monkeypatch: Patch
) -> None:
    """A reflectance that changes nothing gives the photo back: cropped as the truth and the source are."""
    person = found_by_truth(dataset, monkeypatch)
    asked_for = []

    @dataclass(frozen=True, eq=False)
    class Records(Double):
        def images(self, photo: Any, head: Any, lights: Light, target: Any) -> Iterator[np.ndarray]:
            asked_for.append(lights.directions)
            return super().images(photo, head, lights, target)

    light = side_light(person, "C0")
    records = Records("unlit", models=FACE_ONLY)
    (found,) = olats(person, [pair(0, "C0", "C0", light)], [records])
    assert found.source is not None
    inside = found.mask > 0.5
    assert_almost_all_close(found.predictions[COMPOSITE][inside], found.source[inside])
    assert np.abs(found.predictions["unlit"] - found.source)[inside].max() > 2e-3  # no photo's detail
    direction = torch.from_numpy(person.header("C0").directions[light]).float()
    assert torch.equal(asked_for[0], direction[None])


def test_in_another_pose_the_shape_stays_the_sources(dataset: Dataset, monkeypatch: Patch) -> None:
    person = found_by_truth(dataset, monkeypatch)
    source = person.source_of(pair(0, "C0", "C0", 0)).fit_with(FACE_ONLY)
    target = person.under_all_lights("C1")
    posed = target.pose_of(source, FACE_ONLY).fit
    assert torch.equal(posed.alpha, source.fit.alpha) and torch.equal(posed.beta, source.fit.beta)
    own = target.fit_with(FACE_ONLY).fit
    assert torch.equal(posed.rotation, own.rotation) and not torch.equal(posed.alpha, own.alpha)


def test_images_without_a_face_are_left_out_and_named(
    dataset: Dataset, monkeypatch: Patch, caplog: Log
) -> None:
    person = found_by_truth(dataset, monkeypatch, blind="C1")
    light = side_light(person, "C0")
    asked = [pair(0, "C0", "C0", light), pair(1, "C1", "C1", light), pair(2, "C0", "C1", light)]
    with caplog.at_level("WARNING"):
        found = list(olats(person, asked, [unlit()]))
    assert [comparison.case.name for comparison in found] == ["0000/00000"]
    assert sum("skipped" in record.message for record in caplog.records) == 2


@pytest.mark.parametrize("camera", ["C0", "C1"])
def test_a_case_is_the_stacks_image_and_facerf_renders_it_in_its_frame(
    dataset: Dataset, monkeypatch: Patch, camera: str
) -> None:
    """By a reflectance that changes nothing: the photo in its pose, in another the albedo at the face."""
    monkeypatch.setattr(comparisons, "find_faces", lambda *given: [])
    person = person_of(dataset)
    asked = pair(0, "C0", camera, side_light(person, camera))
    (case,) = replace(person, groups=[(asked,)]).compared(freeze, bench(person))
    facts, light = case.case.facts, person.header(camera).directions[asked.target_light]
    truth = read_olats(dataset.stack_path("0000", camera), [asked.target_light])[0].float()
    np.testing.assert_array_equal(case.truth, truth.permute(1, 2, 0))
    direction = azel_to_direction(float(facts["azimuth_deg"]), float(facts["elevation_deg"]))
    np.testing.assert_allclose(direction, light, atol=1e-5)
    assert case.light is not None and case.source is not None and not case.predictions
    weights = envmap_weights(torch.from_numpy(case.light), direction[None])
    np.testing.assert_allclose(weights, 1, rtol=0.01)
    assert facts["yaw_deg"] == pytest.approx({"C0": -15, "C1": 20}[camera], abs=1e-3)
    ours = bench(found_by_truth(dataset, monkeypatch), unlit())
    image = rendered(case.case, case.source, ours, 96)["unlit"]
    inside = case.mask > 0.5
    if camera == "C0":
        assert_almost_all_close(image[inside], case.source[inside])
    else:
        albedo = person.source(pair(0, "C1", "C1", 0))
        assert si_mse(image, albedo, case.mask) < 0.02 * np.square(albedo[inside]).mean()
        large = rendered(case.case, case.source, ours, 192)["unlit"]  # crops of cameras may differ in size
        reduced = large.reshape(96, 2, 96, 2, 3).mean((1, 3))
        assert si_mse(reduced, image, case.mask) < 0.01 * np.square(image[inside]).mean()
    refused(InputError, "0000/00000: has no source, pose and light", rendered, case.case, None, ours, 96)


def test_joint_fits_of_another_face_model_are_refused(person: DatasetPerson, dataset: Dataset) -> None:
    other = DatasetPerson(dataset.model_copy(update={"face_model": "other"}), "0000")
    refused(UsageError, "--face-model", list, other.compared(compare_olats, bench(person)))


def test_open_eyes_are_left_out_unless_they_are_kept(person: DatasetPerson) -> None:
    lit = person.under_all_lights("C0")
    view = lit.fit_with(FACE_ONLY)
    kept = replace(lit, bench=replace(lit.bench, keep_eyes=True), _views={}).fit_with(FACE_ONLY)
    eyes = view.region("eyes") > 0.9
    assert eyes.sum() > 10 and view.mask[eyes].max() < 0.11
    assert kept.mask[eyes].min() > 0.5 and (kept.mask >= view.mask).all()


def test_a_photo_of_which_nothing_is_seen_or_that_is_damaged_is_an_error(person: DatasetPerson) -> None:
    lit = person.under_all_lights("C0")
    unseen = replace(lit.photo, alpha=0 * person.header("C0").seen)
    refused(
        InputError,
        "0000/C0: the fitted face is not visible",
        replace(lit, photo=unseen, _views={}).fit_with,
        FACE_ONLY,
    )

    def compare(*_: object) -> list[Comparison]:
        raise InputError("damaged")

    with pytest.raises(InputError, match="damaged"):
        list(replace(person, groups=[(pair(0, "C0", "C0", 0),)]).compared(compare, bench(person)))


def test_couples_and_presets_are_spread_evenly() -> None:
    sources = [("C0", "a"), ("C0", "b"), ("C1", "a"), ("C1", "a"), ("C1", "c"), ("C0", "a")]
    pairs = [pair(index, camera, camera, 0, envmap) for index, (camera, envmap) in enumerate(sources)]
    couples = [(a.index, b.index) for a, b in couples_of(pairs)]
    assert couples == [(1, 2), (0, 4)]
    groups = {"a": [1, 2, 3, 4], "b": [5], "c": [6, 7]}
    assert evenly(groups, 4, "") == {"a": [1, 2], "b": [5], "c": [6]}
    assert evenly(groups, 99, "") == groups and evenly(groups, 1, "") == {"a": [1]}
    assert angle_class(0, LIGHTS_DEG) == angle_class(30, LIGHTS_DEG) == "0 to 30 deg"
    assert (angle_class(31, LIGHTS_DEG), angle_class(180, LIGHTS_DEG)) == ("30 to 60 deg", "90 to 180 deg")
    assert turn_class(0.1) == "none" and turn_class(100) == "60 to 180 deg"
    assert abs(angle_of(pose_to_rotation(-50, 0, 0)) - 50) < 1e-3


def test_the_papers_pairs_are_of_its_maps_and_as_many_as_there_are(caplog: Log) -> None:
    cameras = ("C0", "C1", "C2")
    many = {
        name: [replace(pair(i, "C0", cameras[i % 3], 0, f"m{i % 200}"), subject=name) for i in range(12_000)]
        for name in ("a", "b")
    }
    chosen = [one for groups in olat_pairs(many, PAPER).values() for (one,) in groups]
    same = sum(one.source_camera == one.target_camera for one in chosen)
    assert (same, len(chosen) - same) == (3900, 8100) and not caplog.messages
    assert {one.envmap for one in chosen} == {f"m{n}" for n in range(160)}
    few = {name: members[:30] for name, members in many.items()}
    assert sum(map(len, olat_pairs(few, PAPER).values())) == 60
    assert any("60" not in line and "all 20 pairs of the same pose" in line for line in caplog.messages)


def test_the_true_light_is_that_of_the_pairs_map(tmp_path: Path) -> None:
    dataset = write_small_dataset(tmp_path / "d", counts=(0, 0, 1), lights=12, crop_px=32)
    words = ["--envmaps", "procedural:2", "--per-subject", "2"]
    assert main(["relight-dataset", str(dataset.folder), *words]) == 0
    person, (first, second) = DatasetPerson(dataset, "0000", reading(crop_px=32)), read_pairs(dataset)
    directions, weights = person.light(second)
    assert directions.shape == (12, 3)
    np.testing.assert_array_equal(weights, load_pairs(dataset)["0000"][1][1])
    written = person.source(first)
    image_path(dataset, *first.key).unlink()
    np.testing.assert_array_equal(person.source(first), written)


def test_traits_are_read_with_the_dataset_and_may_be_missing(dataset: Dataset, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(dataset.folder, tmp_path / "d"))
    content = json.loads((folder / "dataset.json").read_text())
    for traits, tone in (({"ita_deg": -50}, "dark"), (None, "unknown"), ({"ita_deg": "fair"}, "unknown")):
        content["subjects"]["0000"]["traits"] = traits
        if traits is None:
            del content["subjects"]["0000"]["traits"]
        (folder / "dataset.json").write_text(json.dumps(content))
        assert DatasetPerson(read_dataset(folder), "0000", reading()).facts["tone"] == tone
    content["subjects"]["0000"]["traits"] = ["dark"]
    (folder / "dataset.json").write_text(json.dumps(content))
    refused(InputError, "traits", read_dataset, folder)
