"""Extended Yale B as a protocol: its cases, lights and images are those of the benchmark."""

import importlib.util
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.capture.yale_b import Flash, YaleB, read_shifts, read_yale_b
from facerf_cli.errors import InputError
from facerf_cli.evaluation import people, yale_b
from facerf_cli.evaluation.measure import measure
from facerf_cli.evaluation.options import Measures, YaleOptions
from facerf_cli.evaluation.people import Bench, Method
from facerf_cli.evaluation.yale_b import (
    Relighting,
    YaleSubject,
    compare_subject,
    environment_weights,
    face_mask,
)
from facerf_cli.face.morphable import load_face_model
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight
from facerf_cli.person import Person
from facerf_cli.portrait.find import Face
from facerf_cli.relighting.fitting import fit_photo, head_of, reflectance_of
from facerf_cli.relighting.models import Sides, load_models
from tests.capture.yale_fixture import FLASHES, write_pgm, write_yale_b
from tests.conftest import SHARED
from tests.evaluation.method_doubles import FaceModelOnly, Lambert, someone

BENCH = SHARED / "bench" / "yale_b"
SIDES = Sides(256, 512)
OPTIONS = YaleOptions(Path())


@pytest.fixture(scope="module")
def reference() -> Iterator[tuple[ModuleType, ModuleType]]:
    """The benchmark's yale.py and score.py."""
    if not (BENCH / "yale.py").is_file():
        pytest.skip(f"{BENCH} is not here (set FACERF_SHARED)")
    modules = []
    for name in ("yale", "score"):
        spec = importlib.util.spec_from_file_location(name, BENCH / f"{name}.py")
        assert spec is not None and spec.loader is not None
        modules.append(sys.modules.setdefault(name, importlib.util.module_from_spec(spec)))
        spec.loader.exec_module(modules[-1])
    yield modules[0], modules[1]
    for name in ("yale", "score"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def databases(reference: tuple[ModuleType, ModuleType], shared_data: Path) -> tuple[YaleB, Any]:
    """Ours and the benchmark's reading of the same folder."""
    folder = shared_data / "extended_yale_b"
    return read_yale_b(folder, read_shifts(BENCH / "shifts.csv")), reference[0].Yale(str(folder))


def test_cases_and_lights_are_the_benchmarks(
    databases: tuple[YaleB, Any], reference: tuple[ModuleType, ModuleType]
) -> None:
    ours, theirs = databases
    assert ours.subjects == theirs.subjects
    tasks = {"frontal": "A", "soft": "A", "environment": "B"}
    for subject in ours.subjects:
        found = [
            (tasks[one.column], one.source, one.light) for one in YaleSubject(ours, subject).relightings()
        ]
        assert found == theirs.cases(subject)
    flashes = databases[0].flashes("yaleB01")
    named = [(flash.azimuth_deg, flash.elevation_deg) for flash in flashes]
    theirs = np.stack([reference[0].light_dir(*angles) for angles in named])
    np.testing.assert_allclose([flash.direction for flash in flashes], theirs, atol=1e-9)
    for environment in reference[0].ENV:
        weights = environment_weights(environment, flashes)
        np.testing.assert_allclose(weights, reference[0].env_weights(environment, named), atol=1e-9)
    np.testing.assert_array_equal(face_mask(), reference[0].MASK)


@pytest.mark.parametrize("subject", ["yaleB02", "yaleB05", "yaleB13"])
def test_images_are_the_benchmarks(databases: tuple[YaleB, Any], subject: str) -> None:
    ours, theirs = databases
    own = YaleSubject(ours, subject)
    relightings = list(own.relightings())
    for source in {one.source for one in relightings}:
        np.testing.assert_allclose(own.image(source), theirs.source(subject, source), atol=1e-6)
    for light in {one.light for one in relightings}:
        np.testing.assert_allclose(own.image(light), theirs.target(subject, light), atol=1e-6)


def test_scores_are_the_benchmarks(
    databases: tuple[YaleB, Any], reference: tuple[ModuleType, ModuleType]
) -> None:
    bright: Any = SimpleNamespace(
        geometry="landmarks",
        find=lambda image, name: someone(),
        heads=lambda photo, face: [(TooBright(), face)],
    )
    comparisons = list(compare_subject(OPTIONS, bright, (databases[0], "yaleB05")))
    assert len(comparisons) == len(databases[1].cases("yaleB05"))
    for comparison in comparisons[::9]:
        subject, _, light = comparison.case.name.split("/")
        prediction = comparison.predictions["copy"][..., 0]
        theirs = reference[1].measure(prediction, databases[1].target(subject, light))
        (row,) = measure(comparison, Measures(), faces=False)
        for ours, name in (("si_mse", "si_mse"), ("ssim", "ssim"), ("mse", "raw_mse")):
            assert row.values[ours] == pytest.approx(theirs[name], abs=1e-6), (comparison.case.name, ours)


class TooBright:
    """The source itself, twice as bright, so that scale and clipping count."""

    name = "copy"

    def images(self, photo: np.ndarray, face: Face, lights: Light, target: Any) -> list[np.ndarray]:
        assert face.landmarks_px.shape == (68, 2)
        return [2 * photo] * len(lights.weights)


@pytest.fixture
def small(tmp_path: Path) -> YaleB:
    return read_yale_b(write_yale_b(tmp_path / "yale"))


def test_every_method_relights_every_case(small: YaleB, monkeypatch: pytest.MonkeyPatch) -> None:
    fits = Counter[str]()
    monkeypatch.setattr(yale_b, "SOFT_SOURCES", ("dome",))
    monkeypatch.setattr(yale_b, "ENVIRONMENT_SOURCES", ("frontal",))
    monkeypatch.setattr(yale_b, "ENVIRONMENTS", ("env_sky",))
    monkeypatch.setattr(yale_b, "_SOFT_TARGETS", (Flash(0, 0), Flash(-70, 0)))
    monkeypatch.setattr(people, "find_faces", lambda *_: [someone()])
    monkeypatch.setattr(
        Person, "matte_array", property(lambda person: np.ones(person.photo.shape[:2], np.float32))
    )
    monkeypatch.setattr(people, "head_of", lambda *given: fits.update(["fitted"]) or head_of(*given))
    flat = np.full((192, 168), 128)  # an image without detail: the prediction is the method's own
    write_pgm(small.folder / "yaleB07" / "yaleB07_P00A+000E+00.pgm", flat)
    models: Any = FaceModelOnly(load_face_model("builtin"))
    methods: Any = [Lambert("a", models=models), Lambert("b", models=models)]
    bench = Bench(models, SIDES, "landmarks", methods=methods)
    comparisons = list(compare_subject(OPTIONS, bench, (small, "yaleB07")))
    columns = Counter(comparison.case.facts["column"] for comparison in comparisons)
    assert columns == {"frontal": 6, "soft": 2, "environment": 1} and fits["fitted"] == 2  # one a source
    for comparison in comparisons:
        assert set(comparison.predictions) == {"a", "b"}
        assert comparison.truth.shape == comparison.predictions["a"].shape == (192, 168, 3)
        assert comparison.mask.shape == (192, 168) and comparison.case.person == "yaleB07"
    by_name = {comparison.case.name: comparison for comparison in comparisons}
    side = by_name["yaleB07/frontal/A-070E+00"]
    assert side.case.facts["angle"] == "60-80 deg" and side.case.facts["subjects"] == "test"
    assert "angle" not in by_name["yaleB07/dome/A-070E+00"].case.facts
    centre = side.predictions["a"][110, 84]
    np.testing.assert_allclose(centre, np.cos(np.radians(70)), atol=1e-3)
    one = Relighting("frontal", "frontal", "A-070E+00")
    monkeypatch.setattr(YaleSubject, "relightings", lambda self: iter([one]))
    (with_ambient,) = compare_subject(replace(OPTIONS, ambient=0.5), bench, (small, "yaleB07"))
    lighter = with_ambient.predictions["a"][110, 84]
    np.testing.assert_allclose(lighter - centre, 0.5, atol=0.02)  # 48 lights stand for all around


def test_a_subject_without_its_frontal_image(tmp_path: Path) -> None:
    folder = write_yale_b(tmp_path / "yale")
    (folder / "yaleB07" / "yaleB07_P00A+000E+00.pgm").unlink()
    with pytest.raises(InputError, match=r"yaleB07: no undamaged image under A\+000E\+00"):
        bench = Bench(load_models(), SIDES, "landmarks")
        list(compare_subject(OPTIONS, bench, (read_yale_b(folder), "yaleB07")))


def test_environments_come_from_their_side(small: YaleB) -> None:
    flashes = tuple(sorted(FLASHES))
    directions = np.stack([flash.direction for flash in flashes])
    left, right = (environment_weights(name, flashes) @ directions for name in ("win_left", "win_right"))
    assert (
        left[0] < -0.2 and right[0] > 0.2 and environment_weights("overhead", flashes) @ directions[:, 1] > 0
    )
    assert environment_weights("dome", flashes).sum() == pytest.approx(1)


def test_images_are_those_of_relight(small: YaleB, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(people, "find_faces", lambda *_: [someone()])
    models = load_models()
    subject = YaleSubject(small, "yaleB07")
    photo = np.repeat(subject.image("win_left")[..., None], 3, -1)
    head = fit_photo(models, photo, someone().landmarks_px)
    person = Person(models, photo, head, reflectance_of(models, head, "diffuse-sh"))
    directions = torch.from_numpy(np.stack([flash.direction for flash in subject.flashes])).float()
    one = Relighting("environment", "win_left", "env_two_side")
    monkeypatch.setattr(YaleSubject, "relightings", lambda self: iter([one]))
    method = Method("a", "diffuse-sh", models, network_alone=False)
    bench = Bench(models, SIDES, "landmarks", methods=[method])
    (comparison,) = compare_subject(OPTIONS, bench, (small, "yaleB07"))
    weights = torch.from_numpy(subject.weights(one.light)).float()[:, None].expand(-1, 3)
    expected = person.image(RigLight(directions, weights)).mean(-1).clip(0)
    np.testing.assert_allclose(comparison.predictions["a"][..., 1], expected, rtol=1e-4, atol=1e-5)
