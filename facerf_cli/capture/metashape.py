"""Reader for Metashape's XML: the calibrated cameras of a stage (Export Cameras).

Agisoft Metashape, user manual, appendix on camera models, frame cameras: Brown's distortion moves a point
(x, y) of the plane at depth 1, x right and y down; its image lies at f x + b1 x + b2 y + cx from the image's
centre. Its p1 and p2 are OpenCV's p2 and p1.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.texts import read_text

_ADVICE = "use the XML of Metashape's Export Cameras"
_LEAST_TERM = 1e-9  # of b2 in pixels and of k4, which `Capture` does not support
_TERMS = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


def read_metashape(path: Path, unit_m: float = 1.0) -> dict[str, dict[str, Any]]:
    """Read the aligned cameras of the first chunk, by label, as entries of `stage.json`'s cameras.

    `unit_m` is the length of the chunk's unit in metres. Raises InputError for other files, and for lenses
    of other than frame cameras.
    """
    text = read_text(path, _ADVICE)
    if "<!" in text.replace("<!--", ""):
        raise InputError(f"{path}: declares entities; {_ADVICE}")
    try:
        chunk = ElementTree.fromstring(text).find("chunk")
        if chunk is None:
            raise ValueError("no chunk")
        sensors = {sensor.get("id"): sensor for sensor in chunk.findall("sensors/sensor")}
        transform = {part.tag: part.text or "" for part in chunk.findall("transform/*")}
        turn = _numbers(transform.get("rotation", "1 0 0 0 1 0 0 0 1"), 9).reshape(3, 3)
        shift = _numbers(transform.get("translation", "0 0 0"), 3)
        scale = _numbers(transform.get("scale", "1"), 1)
        cameras = {}
        for camera in chunk.iter("camera"):
            if (pose_text := camera.findtext("transform")) is None:
                continue  # not aligned
            name, to_chunk = camera.get("label", ""), _numbers(pose_text, 16).reshape(4, 4)
            rotation = (turn @ to_chunk[:3, :3]).T
            centre_m = unit_m * (scale * turn @ to_chunk[:3, 3] + shift)
            pose = np.column_stack([rotation, -rotation @ centre_m])
            lens = _lens(name, sensors[camera.get("sensor_id")])
            cameras[name] = {"id": name, **lens, "world_to_camera": pose.tolist()}
    except (ElementTree.ParseError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: not a calibration of cameras ({error}); {_ADVICE}") from None
    if not cameras:
        raise InputError(f"{path}: no camera is aligned; {_ADVICE}")
    return cameras


def _lens(name: str, sensor: ElementTree.Element) -> dict[str, Any]:
    """Return size, K and distortion of a sensor, in the form of `stage.json`."""
    calibration = sensor.find("calibration[@class='adjusted']")
    calibration = sensor.find("calibration") if calibration is None else calibration
    if calibration is None or (calibration.get("type") or "frame") != "frame":
        raise ValueError(f"camera {name} is not calibrated as a frame camera")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError(f"camera {name} has no resolution")
    width, height = int(size.get("width", "")), int(size.get("height", ""))
    terms = dict.fromkeys(_TERMS, 0.0)
    terms |= {part.tag: float(part.text or "") for part in calibration if part.tag in (*_TERMS, "f")}
    if max(abs(terms["b2"]), abs(terms["k4"])) > _LEAST_TERM:
        raise ValueError(f"camera {name} has b2 or k4, which are not supported; calibrate without them")
    focal = terms["f"]
    k = [
        [focal + terms["b1"], 0.0, width / 2 + terms["cx"]],
        [0.0, focal, height / 2 + terms["cy"]],
        [0.0, 0.0, 1.0],
    ]
    distortion = [terms["k1"], terms["k2"], terms["p2"], terms["p1"], terms["k3"]]
    return {"width": width, "height": height, "K": k, "distortion": distortion}


def _numbers(text: str, count: int) -> np.ndarray:
    values = np.array(text.split(), np.float64)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"use {count} finite numbers instead of {text[:60]!r}")
    return values
