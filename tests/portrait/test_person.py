"""Normals of another method: the face tells their axes, and the portrait field takes each pixel's own."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from scipy.ndimage import binary_erosion

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.olat_stack import read_olat_header
from facerf_cli.files.write import write_exr
from facerf_cli.image.strips import Window
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.main import main
from facerf_cli.person import Person, fit
from facerf_cli.portrait.person import unit_normals
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.upsampled import UpsampledView
from facerf_cli.work.photos import read_normals
from tests import astronaut
from tests.exr_layers import exr_layers
from tests.kinds import Said
from tests.refusals import refused

TILT = 0.5  # of every other pixel's normal toward x, and away from it


@pytest.fixture(scope="module")
def bumpy() -> np.ndarray:
    """The astronaut's normals in columns of two pixels that are tilted by turns; none in the lowest rows."""
    normals = astronaut.person().normals.copy()
    normals[..., 0] += (normals[..., 2] > 0) * np.where(np.arange(normals.shape[1]) // 2 % 2, TILT, -TILT)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    normals[-60:] = 0
    return normals


def fitted(normals: np.ndarray, **more: Any) -> Person:
    person = astronaut.person()
    return fit(
        person.models, astronaut.photo(), head=person.head, white_balance=None, normals=normals, **more
    )


@pytest.fixture(scope="module")
def person(bumpy: np.ndarray) -> Person:
    """The person with normals whose y is down and z away from the camera."""
    return fitted(bumpy * np.array([1, -1, -1], np.float32))


def field_of(person: Person) -> PortraitField:
    assert isinstance(person.reflectance, PortraitField)
    return person.reflectance


def shown(person: Person, bumpy: np.ndarray) -> np.ndarray:
    """Pixels that the layers have, with normals that are given."""
    return np.asarray((person.matte_array > 0.5) & bumpy.any(-1))


def test_the_layer_has_the_given_normals_in_our_axes_and_the_networks_where_none_are(
    person: Person, bumpy: np.ndarray
) -> None:
    inside, own = shown(person, bumpy), astronaut.person().normals
    np.testing.assert_allclose(person.normals[inside], bumpy[inside], atol=1e-5)
    rest = (person.matte_array > 0.5) & ~bumpy.any(-1)
    rest[:-56] = False  # where the maps' pixels see both
    assert rest.sum() > 5000 and ((person.normals * own).sum(-1)[rest] > 0.999).mean() > 0.99


def test_slopes_are_the_change_of_the_shading_with_the_normals(person: Person) -> None:
    view = replace(field_of(person).views[0], correction=None)
    lights = torch.stack([azel_to_direction(*light) for light in ((60, 20), (-30, 40), (10, -20))])
    weights = torch.tensor([[[1, 0.8, 0.5], [0.3, 0.4, 0.5], [0.1, 0, 1]]])
    step = torch.tensor([3, -5, 8]) * 1e-4
    moved = view.maps._replace(normals=view.maps.normals + step.view(1, 3, 1, 1))
    before, after = (one.shade(lights, weights)[0] for one in (view, replace(view, maps=moved)))
    assert before.normal_gradient is not None
    expected = torch.einsum("ckij,k->cij", before.normal_gradient.unflatten(0, (3, 3)), step)
    away = (after.shading - before.shading - expected).abs()
    away, expected = (view.pixels.values(maps) for maps in (away, expected))
    assert (away < 1e-6).float().mean() > 0.98 and expected.abs().median() > 1e-4


def test_bumps_are_lit_by_their_side(person: Person, bumpy: np.ndarray) -> None:
    inside = shown(person, bumpy) & (bumpy[..., 2] > 0.5)
    inside[:, :2] = False
    tilted_right = inside & (np.arange(inside.shape[1]) // 2 % 2 == 1)
    smooth, light = astronaut.person(), Light.single(50, 10)
    ratio = person.relight(light).mean(-1) / smooth.relight(light).mean(-1).clip(1e-3)
    lit = field_of(person).views[0].maps.normals
    assert (lit.norm(dim=1) - 1).abs().max() < 1e-5
    assert np.median(ratio[tilted_right]) > 1.2 * np.median(ratio[inside & ~tilted_right])


def test_bumps_change_nothing_in_the_photos_own_light(person: Person) -> None:
    view, photo = field_of(person).views[0], astronaut.photo()
    assert view.original is not None
    without = replace(view, person=replace(view.person, normals=None))
    window = Window(slice(100, 140), slice(200, 260))
    shown, plain = (
        enlarged.over(window, photo[window])(enlarged.precompute(view.original, ("normal",)))
        for enlarged in map(UpsampledView, (view, without))
    )
    assert np.abs(shown["normal"] - plain["normal"]).max() > 0.2
    np.testing.assert_allclose(shown["change"], 1, atol=1e-5)


def test_what_are_not_the_normals_of_the_face_is_refused(bumpy: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"use normals of this photo"):
        fitted(bumpy[..., ::-1].copy())  # as OpenCV writes RGB
    refused(
        InputError, "40 x 30 pixels, the photo 512 x 512; use normals of this photo", fitted, bumpy[:30, :40]
    )
    refused(UsageError, "normals: ... remove", fitted, bumpy, reflectance="field")


def test_files_of_each_kind_hold_the_same(bumpy: np.ndarray, tmp_path: Path) -> None:
    """EXR and .npy hold vectors, a PNG 0..1 for -1..1, and black for none; other sizes are resampled."""
    item = Item(tmp_path / "me.jpg", tmp_path / "out/me", "me")
    size = bumpy.shape[:2]
    np.save(tmp_path / "me.npy", bumpy)
    for name, kind, values in (
        ("exr/me.exr", "float", bumpy),
        ("png/me.png", "uint16", np.where(bumpy.any(-1, keepdims=True), bumpy / 2 + 0.5, 0)),
    ):
        path = tmp_path / name
        path.parent.mkdir()
        stream = oiio.ImageOutput.create(str(path))
        assert stream.open(str(path), oiio.ImageSpec(size[1], size[0], 3, kind))
        assert stream.write_image(values.astype(np.float32))
        stream.close()
    for given in (tmp_path, tmp_path / "exr", tmp_path / "png", tmp_path / "{stem}.npy"):
        found = read_normals(item, given, size)
        assert found is not None and np.abs(found - bumpy).max() < 1e-4
    assert read_normals(item, None, size) is None
    half = read_normals(item, tmp_path, (size[0] // 2, size[1] // 2))
    assert half is not None and half.shape == (size[0] // 2, size[1] // 2, 3)
    assert np.unique(np.linalg.norm(half, axis=-1).round(5)).tolist() == [0, 1]


def test_relight_takes_them_and_says_where_they_are_for_nothing(
    bumpy: np.ndarray, person: Person, tmp_path: Path, capsys: Said
) -> None:
    np.save(tmp_path / "astronaut.npy", bumpy[::2, ::2])
    (tmp_path / "in").mkdir()
    path = tmp_path / "in/astronaut.exr"
    write_exr(path, astronaut.photo()[::2, ::2])
    line = ["relight", str(path), "--light", "50,10", "--format", "exr", "-o", str(tmp_path)]
    given = ["--normals-from", str(tmp_path)]
    assert main([*line, *given, "--aov", "normal"]) == 0
    layer = exr_layers(tmp_path / "astronaut_light_50_10.exr")
    found = np.stack([layer[f"normal.{name}"] for name in "XYZ"], -1)
    inside = binary_erosion(shown(person, bumpy)[::2, ::2], iterations=3)  # mattes of two sizes differ
    assert np.abs(found - bumpy[::2, ::2])[inside].max() < 2e-3
    for more, said in (
        (["--reflectance", "field"], "--normals-from: "),
        (["--pose", "20,0,0"], "--normals-from: "),
        (["--sequence"], "--normals-from: "),
    ):
        assert main([*line, *given, *more]) == 2 and said in capsys.readouterr().err
    assert main([*line, "--normals-from", str(tmp_path / "exr")]) == 2
    assert main(["predict-olat", str(path), *given, "--frame", "uv", "-o", str(tmp_path)]) == 2


@pytest.mark.slow
def test_a_stack_and_a_page_hold_them(bumpy: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "astronaut.npy", bumpy)
    line = [str(astronaut.PATH), "--normals-from", str(tmp_path), "--size", "256", "-o", str(tmp_path)]
    assert main(["predict-olat", *line, "--lights", "50,10"]) == 0
    header = read_olat_header(tmp_path / "astronaut_olat.exr")
    normals = unit_normals(bumpy, (256, 256))
    known = (header.seen > 0.9) & normals.any(-1)
    assert np.median((header.normals * normals).sum(-1)[known]) > 0.999
    assert main(["view", *line]) == 0
    assert f"--normals-from {tmp_path}" in (tmp_path / "astronaut.html").read_text()
