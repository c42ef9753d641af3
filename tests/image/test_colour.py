"""Colour spaces against colour-science and OpenColorIO."""

import math
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.errors import UsageError
from facerf_cli.image import colour as ours

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # colour-science warns of optional packages that are not there
    import colour as oracle
from tests.refusals import refused

RGB = np.random.default_rng(3).uniform(-0.2, 3.0, (5, 7, 3)).astype(np.float32)
ENCODED = np.random.default_rng(4).uniform(0.0, 1.0, (5, 7, 3)).astype(np.float32)
ORACLE_NAMES = {
    ours.ACESCG: "ACEScg",
    ours.REC2020: "ITU-R BT.2020",
    ours.LINEAR_REC2020: "ITU-R BT.2020",
    ours.LINEAR_P3: "Display P3",
    ours.ACES: "ACES2065-1",
    ours.DISPLAY_P3: "Display P3",
    ours.LINEAR: "ITU-R BT.709",
}


def test_primaries_luminance_and_curves_are_those_of_colour_science() -> None:
    for space, name in {**ORACLE_NAMES, ours.ADOBE_RGB: "Adobe RGB (1998)"}.items():
        known = oracle.RGB_COLOURSPACES[name]
        assert space.chromaticities == (*known.primaries.ravel(), *known.whitepoint)
    y = oracle.RGB_COLOURSPACES["ITU-R BT.709"].matrix_RGB_to_XYZ[1]
    np.testing.assert_allclose(ours.luminance(RGB), RGB @ y, atol=2e-4)  # the standard prints four digits
    np.testing.assert_allclose(ours.srgb_to_linear(ENCODED), oracle.models.eotf_sRGB(ENCODED), atol=1e-6)
    np.testing.assert_allclose(
        ours.linear_to_srgb(ENCODED), oracle.models.eotf_inverse_sRGB(ENCODED), atol=1e-6
    )
    bt2020 = ours.REC2020.decode(ENCODED)  # type: ignore[misc]
    expected = oracle.models.oetf_inverse_BT2020(ENCODED, is_12_bits_system=True)
    np.testing.assert_allclose(bt2020, expected, atol=2e-4)  # its alpha is the rounded 1.0993
    adobe = ours.ADOBE_RGB.decode(ENCODED)  # type: ignore[misc]
    expected = oracle.RGB_COLOURSPACES["Adobe RGB (1998)"].cctf_decoding(ENCODED)
    np.testing.assert_allclose(adobe, expected, atol=1e-6)


def test_usual_images_do_not_import_colour_science() -> None:
    """sRGB and Display P3, with profiles or without, EXRs and studio lights without a temperature."""
    program = (
        "import sys, numpy as np\n"
        "from facerf_cli.image import colour\n"
        "from facerf_cli.files.icc import space_of_profile\n"
        "from facerf_cli.light.light import StudioLight, intensity_of\n"
        "from tests import icc_profiles\n"
        "spaces = colour.SRGB, colour.ACESCG, colour.LINEAR_REC2020\n"
        "profiles = icc_profiles.DISPLAY_P3, icc_profiles.PROPHOTO\n"
        "spaces += tuple(space_of_profile(profile, '') for profile in profiles)\n"
        "for space in spaces:\n"
        "    colour.to_linear_rec709(np.ones((2, 3, 3), np.uint8), space)\n"
        "intensity_of(StudioLight((0.0, 0.0)))\n"
        "assert 'colour' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def oracle_matrix(name: str) -> np.ndarray:
    source, target = (oracle.RGB_COLOURSPACES[key].copy() for key in (name, "ITU-R BT.709"))
    source.use_derived_transformation_matrices(True)
    target.use_derived_transformation_matrices(True)
    return oracle.matrix_RGB_to_RGB(source, target, "Bradford")


@pytest.mark.parametrize("space", ORACLE_NAMES, ids=lambda space: space.name)
def test_matrices_are_colour_science_s_and_white_stays_white(space: ours.ColourSpace) -> None:
    assert space.chromaticities is not None
    expected = oracle_matrix(ORACLE_NAMES[space])
    np.testing.assert_allclose(ours.matrix_to_rec709(space.chromaticities), expected, atol=2e-6)
    white = ours.to_linear_rec709(np.ones((1, 1, 3), np.float32), space)
    np.testing.assert_allclose(white, 1, atol=1e-6)


@pytest.mark.parametrize("name", ["linear", "ACEScg", "ACES2065-1", "lin_rec2020", "ACEScct", "lin_adobergb"])
def test_from_linear_rec709_is_the_way_back(name: str) -> None:
    space = ours.named_space(name)
    there = ours.from_linear_rec709(RGB.clip(0.01), space)
    np.testing.assert_allclose(ours.to_linear_rec709(there, space), RGB.clip(0.01), rtol=1e-4, atol=1e-4)
    if space.is_linear:
        expected = oracle.RGB_to_RGB(RGB, "ITU-R BT.709", name, "Bradford") if name == "ACEScg" else None
        if expected is not None:
            np.testing.assert_allclose(ours.from_linear_rec709(RGB, space), expected, atol=2e-3)


def test_a_curve_has_no_way_back_and_srgb_has_one_beyond_the_gamut() -> None:
    refused(ValueError, "sRGB is not linear", ours.from_linear_rec709, RGB, ours.SRGB)
    np.testing.assert_allclose(ours.srgb_to_linear(ours.linear_to_srgb(RGB)), RGB, rtol=2e-6, atol=1e-6)
    tall = np.random.default_rng(2).random((700, 500, 3)).astype(np.float32)
    np.testing.assert_array_equal(ours.in_blocks(ours.srgb_to_linear, tall), ours.srgb_to_linear(tall))


def test_the_shoulder_meets_the_plain_curve_with_its_slope_and_never_reaches_1() -> None:
    below = np.linspace(-0.5, 0.8, 50, dtype=np.float32)
    np.testing.assert_array_equal(ours.shoulder(below), below)
    near = np.float32([0.8 + 1e-3, 0.8 + 2e-3])
    assert np.diff(ours.shoulder(near))[0] == pytest.approx(1e-3, rel=0.02)
    assert ours.shoulder(np.float32([1.0]))[0] == pytest.approx(1 - 0.2 / np.e, abs=1e-6)
    above = ours.shoulder(np.linspace(0.8, 2.5, 100, dtype=np.float32))
    assert (np.diff(above) > 0).all() and above.max() < 1


def test_the_soft_view_keeps_hues_and_mixes_white_into_what_it_bends() -> None:
    colours = np.float32(
        [[0.8, 0.5, 0.1], [1.2, 0.6, 0.3], [0.3, 2.4, 1.2], [0.5, 0.5, 3.0], [-0.1, 4.0, 2.0]]
    )
    found = ours.softened(colours)
    np.testing.assert_array_equal(found[0], colours[0])
    brightest = colours.max(-1)
    np.testing.assert_allclose(found.max(-1), ours.shoulder(brightest), rtol=1e-6)
    for before, after, bent in zip(colours[1:], found[1:], ours.shoulder(brightest)[1:], strict=True):
        # the hue: how the middle channel lies between the others
        low, middle, high = np.sort(before)
        seen = np.sort(after)
        assert (seen[1] - seen[0]) / (seen[2] - seen[0]) == pytest.approx(
            (middle - low) / (high - low), abs=1e-5
        )
        kept = (seen[2] - seen[0]) / ((high - low) * bent / high)
        assert kept == pytest.approx(1 / (1 + 0.3 * (high - bent)), rel=1e-5)
    grey = np.linspace(0, 5, 60, dtype=np.float32)[:, None].repeat(3, 1)
    np.testing.assert_allclose(ours.softened(grey), ours.shoulder(grey), rtol=1e-6)


MATRIX = "0.6954522414,0.1406786965,0.1638690622,0, 0.0447945634,0.8596711185,0.0955343182,0, "
MATRIX += "-0.0055258826,0.0040252103,1.0015006723,0, 0,0,0,1"  # ACEScg to ACES2065-1
SHOW = f"""ocio_profile_version: 2
roles: {{scene_linear: Show Linear, ROLE, default: Show Linear}}
displays:
  Monitor:
    - !<View> {{name: Show Look, colorspace: Show Monitor}}
  Projector:
    - !<View> {{name: Raw, colorspace: Show Half}}
    - !<View> {{name: Dim, colorspace: Show Half}}
colorspaces:
  - !<ColorSpace> {{name: ACES2065-1}}
  - !<ColorSpace>
    name: Show Linear
    to_scene_reference: !<MatrixTransform> {{matrix: [{MATRIX}]}}
  - !<ColorSpace>
    name: Show Half
    to_scene_reference: !<GroupTransform>
      children:
        - !<MatrixTransform> {{matrix: [2,0,0,0, 0,2,0,0, 0,0,2,0, 0,0,0,1]}}
        - !<MatrixTransform> {{matrix: [{MATRIX}]}}
  - !<ColorSpace>
    name: Show Monitor
    to_scene_reference: !<GroupTransform>
      children:
        - !<ExponentTransform> {{value: [2, 2, 2, 1]}}
        - !<MatrixTransform> {{matrix: [{MATRIX}]}}
"""


@pytest.mark.parametrize("role", ["aces_interchange: ACES2065-1", "matte_paint: Show Linear"])
def test_a_configuration_of_a_show(tmp_path: Path, role: str) -> None:
    """Also one without the role by which OpenImageIO finds ACES, as older configurations are."""
    (tmp_path / "show.ocio").write_text(SHOW.replace("ROLE", role))
    config = str(tmp_path / "show.ocio")
    half = ours.named_space("show half", config)
    acescg = ours.from_linear_rec709(RGB, ours.ACESCG)
    np.testing.assert_allclose(ours.from_linear_rec709(RGB, half), acescg / 2, atol=1e-4)
    np.testing.assert_allclose(ours.to_linear_rec709(acescg / 2, half), RGB, atol=2e-4)
    view = ours.named_view("show look", config)
    shown = ours.encode_display(RGB.clip(0.01, 0.9), view)
    expected = np.sqrt(ours.from_linear_rec709(RGB.clip(0.01, 0.9), ours.ACESCG))
    np.testing.assert_allclose(shown, expected, atol=1e-4)
    assert not view.is_srgb
    refused(UsageError, "unknown view 'aCES' (known: none, soft, aces, Show", ours.named_view, "aCES", config)


def test_views_of_another_display(tmp_path: Path) -> None:
    (tmp_path / "show.ocio").write_text(SHOW.replace("ROLE", "aces_interchange: ACES2065-1"))
    config = str(tmp_path / "show.ocio")
    dim = ours.named_view("dim", config, "projector")
    assert (dim.name, dim.display) == ("Dim", "Projector") and not dim.is_srgb
    values = RGB.clip(0.01, 0.9)
    half = ours.from_linear_rec709(values, ours.ACESCG) / 2
    np.testing.assert_allclose(ours.encode_display(values, dim), half, atol=1e-4)
    assert ours.named_view("soft", config, "Projector").name == "Raw"  # its default view
    refused(UsageError, "unknown display 'nope' (known: Monitor,", ours.named_view, "soft", config, "nope")
    for name in ("Show Look", "aces"):
        refused(UsageError, "unknown view ... (known: Raw, Dim)", ours.named_view, name, config, "Projector")


def test_a_file_that_is_no_configuration(tmp_path: Path) -> None:
    (tmp_path / "bad.ocio").write_text("hello")
    for look_up in (ours.named_view, ours.named_space):
        refused(UsageError, "bad.ocio: Error", look_up, "Show", str(tmp_path / "bad.ocio"))


def test_spaces_and_views_are_named_by_their_beginning_in_any_spelling() -> None:
    pixels = np.full((2, 3, 3), 0.4135884, np.float32)  # ACEScct's code value of 0.18
    grey = ours.to_linear_rec709(pixels, ours.named_space("acescct"))
    np.testing.assert_allclose(grey, 0.18, rtol=2e-4)
    assert ours.named_space("lin_rec709") is ours.named_space("Linear Rec.709 (sRGB)") is ours.LINEAR
    assert ours.named_space("DISPLAY-P3") is ours.DISPLAY_P3 and ours.named_space("rec 2020") is ours.REC2020
    refused(UsageError, "unknown colour space 'ACEScgg' (similar names: ACEScg", ours.named_space, "ACEScgg")
    with pytest.raises(UsageError, match=r"similar names: linear Rec\.709(, (?!lin_rec709)[^,;]+){2};"):
        ours.named_space("lin_rec709x")  # which has five names
    refused(UsageError, "known: linear Rec.709, sRGB", ours.named_space, "qqqqq")
    assert ours.named_view("un-tone").name == "Un-tone-mapped"
    refused(UsageError, "unknown view 'Z'", ours.named_view, "Z")
    grey = np.full((2, 3, 3), 0.18, np.float32)
    plain = ours.linear_to_srgb(grey)
    for name in ("none", "soft", "Un-tone-mapped", "un-TONE-mapped"):
        np.testing.assert_allclose(ours.encode_display(grey, ours.named_view(name)), plain, atol=2e-4)
    aces = ours.encode_display(grey, ours.named_view("aces"))
    # ACES 2 shows 18 % grey at 10 nits of 100.
    np.testing.assert_allclose(ours.srgb_to_linear(aces), 0.1, atol=0.01)
    assert all(ours.named_view(name).is_srgb for name in ("none", "soft", "aces", "Un-tone-mapped"))
    refused(UsageError, "unknown view 'nope' (known: none, soft, aces, ACES 2", ours.named_view, "nope")


@pytest.mark.parametrize("scale", [1e-4, 1.0, 300.0])
def test_auto_exposure_maps_the_percentile_to_its_target(scale: float) -> None:
    linear = np.random.default_rng(0).random((40, 30, 3)).astype(np.float32) * scale
    exposed = linear * 2 ** ours.auto_exposure_ev(linear)
    high = np.percentile(ours.luminance(exposed), ours.AUTO_EXPOSURE_PERCENTILE)
    assert high == pytest.approx(ours.AUTO_EXPOSURE_TARGET_LINEAR, rel=0.01)


def test_auto_exposure_uses_the_mask_and_leaves_black_alone() -> None:
    linear = np.ones((4, 6, 3), np.float32)
    linear[:, 3:] = 1000
    mask = np.zeros((4, 6), np.float32)
    mask[:, :3] = 1
    assert ours.auto_exposure_ev(linear, mask) == pytest.approx(np.log2(0.8), abs=0.01)
    assert ours.auto_exposure_ev(linear * 0) == 0 and ours.auto_exposure_ev(linear, mask * 0) == 0


def test_the_anchored_exposure_keeps_the_order_and_ratio_of_six_skins() -> None:
    """Six plates in one light, relit by another: as dark beside each other as they were."""
    random = np.random.default_rng(5)
    first, second = random.uniform(0.2, 1, (2, 40, 30, 1))
    face, ratios = np.zeros((40, 30)), []
    face[10:30, 5:25] = 1
    for albedo in (0.02, 0.05, 0.1, 0.2, 0.35, 0.6):
        plate, relit = albedo * first.repeat(3, -1), 7 * albedo * second.repeat(3, -1)
        shown = relit * 2 ** ours.anchored_exposure_ev(relit, plate, face)
        ratios.append(shown[face > 0].mean() / plate[face > 0].mean())
    assert ratios == pytest.approx(np.ones(6), rel=0.005)  # exposures have two decimals


def test_rules_of_exposure_bound_what_light_from_behind_does() -> None:
    plate, relit, mask = np.full((8, 8, 3), 0.1), np.full((8, 8, 3), 0.2), np.ones((8, 8))
    assert ours.chosen_exposure_ev("auto", relit, plate, mask, mask) == -1.0
    assert ours.chosen_exposure_ev("face", relit, plate, mask, mask) == 2.0
    plate, relit = np.full((20, 20, 3), 0.3), np.full((20, 20, 3), 0.001)
    relit[:, :2] = 1.0  # the rim
    face, person = np.zeros((20, 20)), np.ones((20, 20))
    face[:, 5:15] = 1
    assert ours.anchored_exposure_ev(relit, plate, face, person) == 1.0
    assert ours.anchored_exposure_ev(relit, plate, face) == pytest.approx(np.log2(300), abs=0.01)
    assert ours.anchored_exposure_ev(relit, 10 * plate, face, person) == pytest.approx(np.log2(6), abs=0.01)
    assert ours.anchored_exposure_ev(relit * 0, plate, face, person) == 0
    # A face that looks into a light of strength 1 needs 0 EV; twice the light, half of that.
    assert ours.most_exposure_ev("auto", 1.0) == 3.0
    assert ours.most_exposure_ev("auto", 4.0) == 1.0
    assert ours.most_exposure_ev("auto", 0.0) == math.inf == ours.most_exposure_ev("face", 1.0)


def test_one_broken_pixel_sets_no_mean_and_ordinary_photos_stay() -> None:
    photo = np.random.default_rng(0).random((40, 60, 3)).astype(np.float32)
    assert ours.without_fireflies(photo) is photo
    broken = photo.copy()
    broken[7, 9] = 1e6
    limited = ours.without_fireflies(broken)
    assert limited.dtype == np.float32 and abs(limited.mean() / photo.mean() - 1) < 0.01
    assert (limited == broken)[broken < 1].all()
    assert (ours.without_fireflies(photo * 1000) == photo * 1000).all()  # in other units
