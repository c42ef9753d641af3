"""Colour spaces, scene-linear Rec.709, exposure and display views.

Matrices are derived from primaries and white points, with Bradford adaptation to D65 (as OpenColorIO does for
the ACES spaces). Constants agree with colour-science, which is imported only for rare transfer functions and
colour temperatures. Names that are not defined here are looked up in an OpenColorIO configuration.
"""

import difflib
import importlib
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.image import display as ocio

# Chromaticities x, y of red, green, blue and white.
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_P3_CHROMATICITIES = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)
_REC2020_CHROMATICITIES = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.3290)
_AP0_CHROMATICITIES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
_AP1_CHROMATICITIES = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
_ADOBE_CHROMATICITIES = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)

# XYZ to cone responses of the Bradford transform (Lam 1985).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_BLOCK_VALUES = 2**18  # values per block, which fits the processor's cache
# Limits of chromaticities: tolerance of equality, largest coordinate, smallest area or coordinate.
_SAME_XY, _LARGEST_XY, _LEAST_XY = 5e-4, 4.0, 1e-5

AUTO_EXPOSURE_PERCENTILE = 99.0
_FIREFLY = 8.0  # times the 99th percentile, brighter than highlights of skin
ExposureRule = Literal["auto", "face"]
MOST_OVER_FRONT_EV = 3.0  # most extra exposure of a face that the light barely reaches
_BLACK = 1e-9
AUTO_EXPOSURE_TARGET_LINEAR = 0.8  # luminance of that percentile after exposure
SHOULDER_START_LINEAR = AUTO_EXPOSURE_TARGET_LINEAR
_WHITENING = 0.3  # desaturation per amount of compression in the soft view


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB (IEC 61966-2-1), float32 of any shape; negative values are mirrored."""
    size = np.abs(encoded)
    linear = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, encoded).astype(np.float32, copy=False)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode sRGB (IEC 61966-2-1), float32 of any shape, also beyond 1; negative values are mirrored."""
    size = np.abs(linear)
    encoded = size ** (1 / 2.4)
    encoded *= 1.055  # in place: twice as fast
    encoded -= 0.055
    np.multiply(size, 12.92, out=encoded, where=size <= 0.0031308)
    return np.copysign(encoded, linear, out=encoded).astype(np.float32, copy=False)


@cache
def colour_science() -> Any:
    """Import colour-science without its warnings and side effects, which takes most of a second.

    OpenImageIO is hidden: colour-science would keep its types alive, which it reports as leaks at exit.
    """
    modules: dict[str, Any] = sys.modules
    openimageio, modules["OpenImageIO"] = modules["OpenImageIO"], None
    try:
        with np.printoptions(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about its optional dependencies
            return importlib.import_module("colour")
    finally:
        modules["OpenImageIO"] = openimageio


def power_curve(gamma: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the decoding curve value^gamma; negative values are mirrored."""

    def decode(encoded: np.ndarray) -> np.ndarray:
        return np.copysign(np.abs(encoded) ** gamma, encoded).astype(np.float32)

    return decode


def _bt2020_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Invert the transfer function of ITU-R BT.2020 with its 12-bit constants."""
    decoded = colour_science().models.oetf_inverse_BT2020(np.abs(encoded), is_12_bits_system=True)
    return np.copysign(decoded, encoded).astype(np.float32)


@dataclass(frozen=True)
class ColourSpace:
    """Colour space with primaries and a decoding curve; without primaries OpenColorIO converts it."""

    name: str
    chromaticities: tuple[float, ...] | None
    decode: Callable[[np.ndarray], np.ndarray] | None = None  # None if linear
    config: str = ""  # OpenColorIO configuration that defines the name

    @property
    def is_linear(self) -> bool:
        """True if values are proportional to light; False if that is unknown."""
        return self.chromaticities is not None and self.decode is None


LINEAR = ColourSpace("linear Rec.709", REC709_CHROMATICITIES)
SRGB = ColourSpace("sRGB", REC709_CHROMATICITIES, srgb_to_linear)
DISPLAY_P3 = ColourSpace("Display P3", _P3_CHROMATICITIES, srgb_to_linear)
ADOBE_RGB = ColourSpace("Adobe RGB", _ADOBE_CHROMATICITIES, power_curve(563 / 256))
ACESCG = ColourSpace("ACEScg", _AP1_CHROMATICITIES)
REC2020 = ColourSpace("Rec.2020", _REC2020_CHROMATICITIES, _bt2020_to_linear)
LINEAR_REC2020 = ColourSpace("linear Rec.2020", _REC2020_CHROMATICITIES)
LINEAR_P3 = ColourSpace("linear P3", _P3_CHROMATICITIES)
ACES = ColourSpace("ACES2065-1", _AP0_CHROMATICITIES)

# Without case, spaces and punctuation; includes OpenImageIO's interchange names.
_ALIASES = {
    LINEAR: "linear linrec709 linearrec709 linrec709scene linsrgb linearrec709srgb",
    SRGB: "srgb srgbrec709scene srgbtexture srgbtx srgbencodedrec709srgb",
    DISPLAY_P3: "displayp3 p3 srgbp3d65scene srgbdisplayp3",
    ADOBE_RGB: "adobergb adobergb1998 g22adobergbscene",
    ACESCG: "acescg linap1 linap1scene",
    REC2020: "rec2020 bt2020",
    LINEAR_REC2020: "linrec2020 linearrec2020 linrec2020scene",
    LINEAR_P3: "linearp3 linp3d65 linp3d65scene linearp3d65",
    ACES: "aces20651 linap0 linap0scene",
}
_BY_ALIAS = {alias: space for space, aliases in _ALIASES.items() for alias in aliases.split()}


def find_space(name: str, config: str = "") -> ColourSpace | None:
    """Return the space of this name, defined here or by OpenColorIO; None if unknown."""
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    if plain in _BY_ALIAS:
        return _BY_ALIAS[plain]
    return ColourSpace(name, None, None, config) if name.casefold() in ocio.names(config) else None


def known_space(space: ColourSpace) -> ColourSpace:
    """Return the named space with the same primaries and curve, or the space itself."""
    alike = (known for known in _ALIASES if known.decode is space.decode)
    return next((known for known in alike if known.chromaticities == space.chromaticities), space)


def linear_space(chromaticities: tuple[float, ...]) -> ColourSpace | None:
    """Return the linear space of these primaries and white, by its usual name if it has one.

    None for impossible ones: white must be inside the triangle of the primaries.
    """
    xy = np.array(chromaticities, float).reshape(4, 2)
    if not (np.abs(xy) < _LARGEST_XY).all() or not (np.abs(xy[:, 1]) > _LEAST_XY).all():
        return None
    columns = np.vstack([xy.T, np.ones(4)])
    is_flat = abs(np.linalg.det(columns[:, :3])) < _LEAST_XY
    if is_flat or not (np.linalg.solve(columns[:, :3], columns[:, 3]) > _LEAST_XY).all():
        return None
    for space in _ALIASES:
        if space.is_linear and np.allclose(np.array(space.chromaticities), xy.ravel(), 0, _SAME_XY):
            return space
    return ColourSpace("linear, by its chromaticities", tuple(chromaticities))


def named_space(name: str, config: str = "") -> ColourSpace:
    """Return the space that a user names; raises UsageError with similar names for an unknown one."""
    space = find_space(name, config)
    if space is None:
        ours = [known.name for known in _ALIASES]
        names = {known.casefold(): known for known in ours} | ocio.names(config)
        near = difflib.get_close_matches(name.casefold(), names, len(names), 0.5)
        similar = dict.fromkeys(known.name for key in near if (known := find_space(names[key], config)))
        hint = f"similar names: {', '.join([*similar][:3])}" if similar else f"known: {', '.join(ours)}"
        raise UsageError(f"unknown colour space '{name}' ({hint}; and the names of the OCIO configuration)")
    return space


def to_linear_rec709(pixels: np.ndarray, space: ColourSpace) -> np.ndarray:
    """Convert [H, W, 3] from `space` to scene-linear Rec.709, unclipped: wide gamuts give negative values.

    Unsigned integers are scaled to 0..1 and decoded by a lookup table.
    """
    if pixels.dtype.kind == "u" and space.chromaticities is not None:
        return _by_matrix(_looked_up(pixels, space), matrix_to_rec709(space.chromaticities))
    pixels = unit_floats(pixels)
    if space.chromaticities is None:
        for name, matrix in _ocio_bridges():
            converted = ocio.converted(pixels, space.name, name, space.config)
            if converted is not None:
                return _by_matrix(converted, matrix)
        raise _cannot_convert(space)
    linear = pixels if space.decode is None else in_blocks(space.decode, pixels)
    return _by_matrix(linear, matrix_to_rec709(space.chromaticities))


def _looked_up(integers: np.ndarray, space: ColourSpace) -> np.ndarray:
    """Decode unsigned integers [H, W, 3] by the curves of a space, computed once per value."""
    values = unit_floats(np.arange(np.iinfo(integers.dtype).max + 1, dtype=integers.dtype))
    grey = np.repeat(values[:, None, None], 3, -1)  # a profile has one curve per channel
    table = (grey if space.decode is None else space.decode(grey))[:, 0]
    linear = np.empty(integers.shape, np.float32)
    for channel in range(3):
        linear[..., channel] = table[:, channel][integers[..., channel]]
    return linear


def unit_floats(values: np.ndarray) -> np.ndarray:
    """Convert to float32; unsigned integers are scaled to 0..1."""
    if values.dtype.kind != "u":
        return values.astype(np.float32, copy=False)
    return values.astype(np.float32) * (1 / np.float32(np.iinfo(values.dtype).max))  # as in OpenImageIO


def from_linear_rec709(pixels: np.ndarray, space: ColourSpace) -> np.ndarray:
    """Convert scene-linear Rec.709 [H, W, 3] to a linear or an OpenColorIO space, unclipped."""
    if space.chromaticities is None:
        for name, matrix in _ocio_bridges():
            bridge = _by_matrix(pixels, np.linalg.inv(matrix))
            converted = ocio.converted(bridge, name, space.name, space.config)
            if converted is not None:
                return converted
        raise _cannot_convert(space)
    if space.decode is not None:
        raise ValueError(f"{space.name} is not linear")
    return _by_matrix(pixels, np.linalg.inv(matrix_to_rec709(space.chromaticities)))


def _by_matrix(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Multiply colours [H, W, 3] by a matrix [3, 3]."""
    if np.allclose(matrix, np.eye(3), atol=1e-6):
        return pixels.astype(np.float32, copy=False)
    return pixels @ matrix.T.astype(np.float32)


def _ocio_bridges() -> Iterator[tuple[str, np.ndarray]]:
    """Yield names of linear spaces that configurations may have, with their matrix to linear Rec.709."""
    yield from ((name, np.eye(3)) for name in ocio.REC709_NAMES)
    yield from ((name, matrix_to_rec709(_AP0_CHROMATICITIES)) for name in ocio.ACES_NAMES)


def _cannot_convert(space: ColourSpace) -> UsageError:
    return UsageError(
        f"'{space.name}': OpenColorIO cannot convert it; use one with linear Rec.709 or ACES2065-1"
    )


def in_blocks(
    curve: Callable[[np.ndarray], np.ndarray], pixels: np.ndarray, kind: type = np.float32
) -> np.ndarray:
    """Apply a curve to [H, W, C] in blocks of rows that fit the cache, which is several times faster."""
    rows = max(1, _BLOCK_VALUES // max(1, pixels[0].size))
    result: np.ndarray = np.empty(pixels.shape, kind)
    for start in range(0, len(pixels), rows):
        result[start : start + rows] = curve(pixels[start : start + rows])
    return result


def rgb_to_xyz(chromaticities: tuple[float, ...]) -> np.ndarray:
    """Return the matrix [3, 3] from linear RGB of these primaries to XYZ, with Y = 1 for white."""
    xy = np.array(chromaticities, float).reshape(4, 2)
    xyz = np.concatenate([xy, 1 - xy.sum(-1, keepdims=True)], -1) / xy[:, 1:]  # [4, 3], each with Y = 1
    return xyz[:3].T * np.linalg.solve(xyz[:3].T, xyz[3])


def matrix_to_rec709(chromaticities: tuple[float, ...]) -> np.ndarray:
    """Return the matrix [3, 3] from linear RGB of these primaries to linear Rec.709 (Bradford adaptation)."""
    source, target = rgb_to_xyz(chromaticities), rgb_to_xyz(REC709_CHROMATICITIES)
    return np.linalg.inv(target) @ adaptation(source.sum(1), target.sum(1)) @ source


def adaptation(from_white: np.ndarray, to_white: np.ndarray) -> np.ndarray:
    """Return the Bradford adaptation matrix [3, 3] between two whites, XYZ [3]."""
    gain = (_BRADFORD @ to_white) / (_BRADFORD @ from_white)
    return np.linalg.inv(_BRADFORD) @ (gain[:, None] * _BRADFORD)


def luminance(linear: np.ndarray) -> np.ndarray:
    """Return the luminance Y [...] of linear Rec.709 [..., 3]."""
    return linear @ rgb_to_xyz(REC709_CHROMATICITIES)[1].astype(linear.dtype)


def lab_d65(linear: np.ndarray) -> np.ndarray:
    """Convert linear Rec.709 [..., 3] to CIE L*a*b* under D65 [..., 3]."""
    matrix = rgb_to_xyz(REC709_CHROMATICITIES)
    relative = linear @ matrix.T / matrix.sum(1)
    root = np.where(relative > (6 / 29) ** 3, np.cbrt(relative), relative / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def ita_deg(linear: np.ndarray) -> np.ndarray:
    """Return the individual typology angle in degrees [...] of linear Rec.709 albedo [..., 3].

    atan((L* - 50) / b*) under D65, higher for lighter skin (Chardon et al., *Skin colour typology and
    suntanning pathways*, 1991).
    """
    lab = lab_d65(linear)
    return np.degrees(np.arctan2(lab[..., 0] - 50, lab[..., 2]))


def without_fireflies(linear: np.ndarray) -> np.ndarray:
    """Limit [H, W, 3] to 8 times its 99th percentile, at least 1, so that means ignore single hot pixels."""
    if linear.max() <= 1:
        return linear
    return np.minimum(linear, max(1.0, _FIREFLY * float(np.percentile(linear, 99))), dtype=linear.dtype)


def auto_exposure_ev(linear: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the exposure in EV, to two decimals, that maps the 99th percentile of the luminance to 0.8.

    `linear` is [H, W, 3]; only pixels where `mask` [H, W] exceeds one half count. A black image gives 0 EV.
    """
    whole = np.ones(linear.shape[:2]) if mask is None else mask
    high = _brighter_than(linear, whole, AUTO_EXPOSURE_PERCENTILE)
    return round(float(np.log2(AUTO_EXPOSURE_TARGET_LINEAR / high)), 2) if high > _BLACK else 0.0


def display_ev(linear: np.ndarray) -> float:
    """Return `auto_exposure_ev` of an image [H, W, 3], measured on a grid of at most 2048 pixels a side."""
    stride = max(1, max(linear.shape[:2]) // 1024)
    return auto_exposure_ev(linear[::stride, ::stride])


def to_display(linear: np.ndarray, exposure_ev: float | None = None) -> np.ndarray:
    """Convert a scene-linear image [H, W, 3] to sRGB uint8, by default at the exposure `display_ev`."""
    gain = np.float32(2.0 ** (display_ev(linear) if exposure_ev is None else exposure_ev))
    return in_blocks(
        lambda block: np.round(linear_to_srgb((block * gain).clip(0, 1)) * 255), linear, np.uint8
    )


def anchored_exposure_ev(
    relit: np.ndarray, plate: np.ndarray, face: np.ndarray, person: np.ndarray | None = None
) -> float:
    """Return the exposure in EV, to two decimals, that keeps a face's mean luminance of the plate.

    Images are [H, W, 3]; masks [H, W] count where they exceed one half. The person then fits an unchanged
    background, and the contrast between dark and light skin is kept. The exposure is limited so that the
    brightest hundredth of the person exceeds white, or the plate's, by at most one EV (rear light). A black
    face gives 0 EV.
    """
    relit_mean, plate_mean = (_mean_luminance(image, face) for image in (relit, plate))
    if min(relit_mean, plate_mean) <= _BLACK:
        return 0.0
    mask = face if person is None else person
    relit_high, plate_high = (
        _brighter_than(image, mask, AUTO_EXPOSURE_PERCENTILE) for image in (relit, plate)
    )
    gain = min(plate_mean / relit_mean, 2 * max(1.0, plate_high) / max(relit_high, _BLACK))
    return round(float(np.log2(gain)), 2)


def chosen_exposure_ev(
    rule: ExposureRule, relit: np.ndarray, plate: np.ndarray, face: np.ndarray, person: np.ndarray
) -> float:
    """Return the exposure in EV by a rule: `auto` keeps the plate's brightness, `face` exposes the person."""
    if rule == "face":
        return auto_exposure_ev(relit, person)
    return anchored_exposure_ev(relit, plate, face, person)


def most_exposure_ev(rule: ExposureRule, strength: float) -> float:
    """Return the largest exposure in EV under light of a total luminance (`Light.strengths`).

    A face toward a light of strength 1 needs 0 EV for the brightness of its photo. Under `auto`, the limit
    keeps a face under rear light dark.
    """
    limited = rule == "auto" and strength > _BLACK
    return MOST_OVER_FRONT_EV - math.log2(strength) if limited else math.inf


def _mean_luminance(linear: np.ndarray, mask: np.ndarray) -> float:
    values = luminance(linear)[mask > 0.5]
    return float(values.mean()) if values.size else 0.0


def _brighter_than(linear: np.ndarray, mask: np.ndarray, percentile: float) -> float:
    values = luminance(linear)[mask > 0.5]
    return float(np.percentile(values, percentile)) if values.size else 0.0


@dataclass(frozen=True)
class View:
    """Display view: "none" is the sRGB curve, clipped at 1; "soft" applies `softened` first.

    Others are views of a display of an OpenColorIO configuration; '' is its default display.
    """

    name: str = "none"
    config: str = ""
    display: str = ""

    @property
    def is_srgb(self) -> bool:
        """True if the encoded values are known to be sRGB."""
        return (
            self.name in ("none", "soft") or "srgb" in (self.display or ocio.display(self.config)).casefold()
        )


PLAIN_VIEW, SOFT_VIEW = View("none"), View("soft")
_ACES_VIEW = View("ACES 2.0 - SDR 100 nits (Rec.709)", "ocio://default")
_VIEWS = {"none": PLAIN_VIEW, "soft": SOFT_VIEW, "aces": _ACES_VIEW}


def named_view(name: str, config: str = "", display: str = "") -> View:
    """Return the view that a user names; raises UsageError with the known names for an unknown one.

    With a display, the view is one of its views; "soft", the default of the option, is its default view.
    """
    if not display and name in _VIEWS:
        return _VIEWS[name]
    if display:
        display = _spelt(display, ocio.displays(config), "display")
        name = ocio.views(config, display)[0] if name == SOFT_VIEW.name else name
    known = ocio.views(config, display)
    return View(_spelt(name, known, "view", () if display else tuple(_VIEWS)), config, display)


def _spelt(name: str, known: Sequence[str], what: str, more: Sequence[str] = ()) -> str:
    """Return a known name in its spelling, given in full or by an unambiguous start."""
    for alike in (str.__eq__, str.startswith):
        matches = [spelt for spelt in known if alike(spelt.casefold(), name.casefold())]
        if len(matches) == 1:
            return matches[0]
    raise UsageError(f"unknown {what} '{name}' (known: {', '.join([*more, *known])})")


def shoulder(linear: np.ndarray) -> np.ndarray:
    """Keep values up to s = 0.8 and compress higher ones: 1 - (1 - s) exp(-(x - s) / (1 - s))."""
    start = np.float32(SHOULDER_START_LINEAR)
    above = np.maximum(linear - start, 0) / (1 - start)
    return np.where(above > 0, 1 - (1 - start) * np.exp(-above), linear)


def softened(linear: np.ndarray) -> np.ndarray:
    """Compress colours [..., 3] whose brightest channel is above the shoulder's start; their hue is kept.

    All channels follow the brightest one, and white is mixed in by the amount of compression, as in Khronos'
    PBR Neutral tone mapper (2024). With separate channels, bright skin and leaves would turn yellow.
    """
    brightest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
    is_bright = brightest > SHOULDER_START_LINEAR
    brightest = brightest[is_bright][:, None]
    compressed = shoulder(brightest)
    colour = linear[is_bright] * (compressed / brightest)
    result = linear.copy()
    result[is_bright] = compressed + (colour - compressed) / (1 + _WHITENING * (brightest - compressed))
    return result


def encode_display(
    linear: np.ndarray, view: View, share: np.ndarray | None = None, added: np.ndarray | None = None
) -> np.ndarray:
    """Encode exposed linear Rec.709 [H, W, 3] for a display, 0..1.

    `share` [H, W] in 0..1 is the strength of the soft shoulder; photographed pixels, which have been encoded
    before, keep their look without it. Where light was `added` [H, W, 3] to the photo, the shoulder applies
    only to that light.
    """
    if view.name == "none":
        return in_blocks(lambda block: linear_to_srgb(np.clip(block, 0, 1)), linear)
    if view.name == "soft":
        soft = in_blocks(softened, linear)
        if added is not None:
            photographed = linear - added
            mixed = soft + (photographed - in_blocks(softened, photographed))
        else:
            mixed = soft if share is None else linear + share[..., None] * (soft - linear)
        return encode_display(mixed, PLAIN_VIEW)
    for name, matrix in _ocio_bridges():
        bridge = _by_matrix(linear, np.linalg.inv(matrix))
        displayed = ocio.displayed(bridge, name, view.name, view.config, view.display)
        if displayed is not None:
            return displayed.clip(0, 1)
    raise _cannot_convert(ColourSpace(view.name, None))
