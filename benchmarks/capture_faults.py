"""The faults that `planted_faults.py` plants in copies of a capture, each at several strengths."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from capture_copy import Copy
from scipy import ndimage


@dataclass(frozen=True)
class Fault:
    """What is planted, which gives the lights whose frames it touches: none if it is of the whole subject."""

    name: str
    strength: str
    checks: tuple[str, ...]  # under which it may be found
    plant: Callable[[Copy], Sequence[str]]
    cameras: int = 1


def one(change: Callable[[np.ndarray], np.ndarray], place: int = 3) -> Callable[[Copy], Sequence[str]]:
    """The frame of one light in front is changed."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[place]
        copy.write(light, change(copy.read(light)))
        return [light]

    return plant


def every(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Copy], Sequence[str]]:
    """All frames are changed."""

    def plant(copy: Copy) -> list[str]:
        for light in copy.ids:
            copy.write(light, change(copy.read(light)))
        return []

    return plant


def missing(copy: Copy) -> list[str]:
    light = copy.front()[3]
    copy.path(light).unlink()
    return [light]


def extra(copy: Copy) -> list[str]:
    copy.write("L900", copy.read(copy.front()[3]) * 0.9)
    return []


def truncated(share: float) -> Callable[[Copy], Sequence[str]]:
    def plant(copy: Copy) -> list[str]:
        path = copy.path(light := copy.front()[3])
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        return [light]

    return plant


def duplicate(copy: Copy) -> list[str]:
    light = copy.front()[3]
    shutil.copyfile(copy.path(copy.far(light)), copy.path(light))
    return [light]


def nans(share: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(pixels: np.ndarray) -> np.ndarray:
        spoiled = np.random.default_rng(0).random(pixels.shape[:2]) < share
        return np.where(spoiled[..., None], np.float32(np.nan), pixels)

    return change


def swapped(apart: str) -> Callable[[Copy], Sequence[str]]:
    """The frames of two lights under each other's names."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[3]
        other = {"near": copy.near, "far": copy.far}[apart](light)
        first, second = copy.read(light), copy.read(other)
        copy.write(light, second)
        copy.write(other, first)
        return [light, other]

    return plant


def rolled(copy: Copy) -> list[str]:
    """Each frame under the name of the next light."""
    lights = copy.description["lights"]
    directions = [light["direction"] for light in lights]
    for light, direction in zip(lights, [*directions[1:], directions[0]], strict=True):
        light["direction"] = direction
    return []


def rig(matrix: np.ndarray) -> Callable[[Copy], Sequence[str]]:
    def plant(copy: Copy) -> list[str]:
        for light in copy.description["lights"]:
            light["direction"] = (matrix @ np.array(light["direction"])).tolist()
        return []

    return plant


def about_y(angle_deg: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def misplaced(angle_deg: float) -> Callable[[Copy], Sequence[str]]:
    """The second camera's pose is turned about the head."""

    def plant(copy: Copy) -> list[str]:
        camera = copy.description["cameras"][1]
        pose = np.array(camera["world_to_camera"])[:3]
        pose[:, :3] = pose[:, :3] @ about_y(angle_deg)
        camera["world_to_camera"] = pose.tolist()
        return []

    return plant


def cameras_swapped(copy: Copy) -> list[str]:
    first, second = (copy.path("", camera).parent for camera in (copy.cameras[0], copy.cameras[-1]))
    aside = first.with_name("aside")
    for old, new in ((first, aside), (second, first), (aside, second)):
        old.rename(new)
    return []


def woven(other: str) -> Callable[[Copy], Sequence[str]]:
    """Even rows of a frame are those of another light."""

    def plant(copy: Copy) -> list[str]:
        light = copy.front()[3]
        pixels = copy.read(light)
        pixels[::2] = copy.read({"near": copy.near, "far": copy.far}[other](light))[::2]
        copy.write(light, pixels)
        return [light]

    return plant


def with_full(exponent: float) -> Callable[[Copy], Sequence[str]]:
    """A frame of all lamps beside the others, all of them encoded."""

    def plant(copy: Copy) -> Sequence[str]:
        copy.write("full", sum(copy.read(light) for light in copy.ids) ** (1 / exponent))
        return every(encoded(exponent))(copy)

    return plant


def encoded(exponent: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pixels: np.maximum(pixels, 0) ** (1 / exponent)


def clipped(share: float) -> Callable[[Copy], Sequence[str]]:
    """Cut off where the most frontal frame has a share of its pixels above."""

    def plant(copy: Copy) -> Sequence[str]:
        ceiling = np.quantile(copy.read(copy.front()[0]).max(-1), 1 - share)
        return every(lambda pixels: np.minimum(pixels, np.float32(ceiling)))(copy)

    return plant


def moved(by_px: float) -> Callable[[Copy], Sequence[str]]:
    """A third of the frames, moved in several directions."""

    def plant(copy: Copy) -> list[str]:
        for place, light in enumerate(copy.ids[::3]):
            angle = 2.4 * place
            shift = (by_px * np.sin(angle), by_px * np.cos(angle), 0)
            copy.write(light, ndimage.shift(copy.read(light), shift, order=3, mode="nearest"))
        return []

    return plant


MIRROR = np.diag([-1.0, 1, 1])
FAULTS = (
    Fault("missing frame", "1", ("missing",), missing),
    Fault("extra frame", "1", ("extra",), extra),
    Fault("wrong resolution", "half", ("resolution",), one(lambda pixels: pixels[::2, ::2])),
    Fault("file cut short", "at 5 %", ("unreadable",), truncated(0.05)),
    Fault("file cut short", "at 95 %", ("unreadable",), truncated(0.95)),
    Fault("NaN", "1 pixel in 1000", ("not finite",), one(nans(0.001))),
    Fault("NaN", "1 pixel in 10", ("not finite",), one(nans(0.1))),
    Fault("NaN", "all", ("not finite", "black"), one(nans(1.0))),
    Fault("black frame", "1", ("black",), one(np.zeros_like)),
    Fault("duplicate frame", "1", ("duplicate",), duplicate),
    Fault("clipped", "0.5 % of a frame", ("clipped",), clipped(0.005)),
    Fault("clipped", "2 %", ("clipped",), clipped(0.02)),
    Fault("clipped", "10 %", ("clipped",), clipped(0.1)),
    Fault("lamp dim", "at 50 %", ("unlit",), one(lambda pixels: pixels * 0.5)),
    Fault("lamp dim", "at 20 %", ("unlit",), one(lambda pixels: pixels * 0.2)),
    Fault("lamp did not fire", "at 2 %", ("unlit", "black"), one(lambda pixels: pixels * 0.02)),
    Fault("two swapped", "neighbours", ("order",), swapped("near")),
    Fault("two swapped", "far apart", ("order",), swapped("far")),
    Fault("all shifted by one", "", ("order", "rig"), rolled),
    Fault("rig mirrored", "", ("rig",), rig(MIRROR)),
    Fault("rig turned", "10 degrees", ("rig",), rig(about_y(10))),
    Fault("rig turned", "25 degrees", ("rig",), rig(about_y(25))),
    Fault("rig turned", "45 degrees", ("rig",), rig(about_y(45))),
    Fault("camera misplaced", "by 40 degrees, 1 of 3", ("camera",), misplaced(40), 3),
    Fault("camera misplaced", "by 60 degrees, 1 of 3", ("camera",), misplaced(60), 3),
    Fault("cameras swapped", "2 of 2", ("camera", "rig"), cameras_swapped, 2),
    Fault("cameras swapped", "2 of 3", ("camera", "rig"), cameras_swapped, 3),
    Fault("two fields", "of neighbours", ("fields",), woven("near")),
    Fault("two fields", "of lamps far apart", ("fields",), woven("far")),
    Fault("gamma", "1.4", ("gamma",), every(encoded(1.4))),
    Fault("gamma", "1.8", ("gamma",), every(encoded(1.8))),
    Fault("gamma", "2.2", ("gamma",), every(encoded(2.2))),
    Fault("gamma, with a full-on frame", "1.2", ("gamma",), with_full(1.2)),
    Fault("head moves in a third", "1 px", ("motion",), moved(1)),
    Fault("head moves in a third", "2 px", ("motion",), moved(2)),
    Fault("head moves in a third", "3 px", ("motion",), moved(3)),
    Fault("head moves in a third", "4 px", ("motion",), moved(4)),
)
