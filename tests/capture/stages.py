"""Small captures in the layouts of public light stages, rewritten from one with `stage.json`."""

import json
from pathlib import Path

import numpy as np

from facerf_cli.capture.layouts import read_capture
from facerf_cli.files.write import write_exr
from tests.dataset.capture import HEAD_WORLD

SHIFT_MM = np.array([640.0, 400.0, 500.0])  # of the stage's axes, in which the head is where FaceOLAT's is
COLOURS = np.array([[1.2, -0.1, 0.0], [0.1, 0.8, -0.05], [0.0, 0.2, 1.5]])
BLACK = np.array([0.01, 0.02, 0.03])
# A calibration of one camera, by Metashape.
LENS = """<document><chunk><sensors><sensor id="0"><calibration class="adjusted">
<resolution width="200" height="100"/><f>180</f><cx>3</cx><cy>-2</cy><b1>0.5</b1><k1>-0.1</k1><k2>0.02</k2>
<k3>0.003</k3><p1>0.004</p1><p2>-0.005</p2></calibration></sensor></sensors><cameras>
<camera sensor_id="0" label="A"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras>
</chunk></document>"""
_TURN = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])  # of Metashape's chunk
_SCALE, _TRACKING_EVERY = 250.0, 5


def write_faceolat(stage: Path, folder: Path, radius_m: float, dark: str = "") -> dict[str, str]:
    """Rewrite a stage as EXR files of FaceOLAT, its lights at a distance from the head; takes by subject."""
    capture = read_capture(stage)
    takes = {name: f"ID10{number:03d}" for number, name in enumerate(capture.subjects, 1)}
    takes |= {dark: "ID20090"} if dark else {}
    middle_mm = 1000 * HEAD_WORLD.numpy() + SHIFT_MM
    places = middle_mm + 1000 * radius_m * capture.directions_world
    order, pairs = np.random.default_rng(1).permutation(len(places)), []
    for light in order:
        if len(pairs) % _TRACKING_EVERY == 0:
            pairs.append([len(pairs), 0])
        pairs.append([len(pairs), int(light) + 1])
    _write_json(folder / "lights/light_pattern_per_frame.json", pairs)
    _write_json(
        folder / "lights/light_pattern_metadata.json", {"light_positions": places.tolist(), "fps": 60}
    )
    (folder / "colorcalib.mat").write_text(
        "\n".join(" ".join(map(str, row)) for row in np.c_[COLOURS, BLACK])
    )
    (folder / "calibration/cameras").mkdir(parents=True)
    sensors, cameras = "", ""
    for number, (name, posed) in enumerate(capture.cameras.items()):
        label = f"Cam{number:02d}"
        flip = np.diag([1.0, -1.0, -1.0])
        rotation, shift_mm = flip @ posed.rotation.numpy(), 1000 * flip @ posed.translation_m.numpy()
        centre = _TURN.T @ (-rotation.T @ shift_mm + SHIFT_MM) / _SCALE
        to_chunk = np.eye(4)
        to_chunk[:3] = np.c_[_TURN.T @ rotation.T, centre]
        width, height = posed.width_px, posed.height_px
        size = f'<resolution width="{width}" height="{height}"/>'
        sensors += (
            f'<sensor id="{number}" label="{label}" type="frame">{size}'
            f'<calibration type="frame" class="adjusted">{size}'
            f"<f>{posed.focal_px[1]}</f><cx>{posed.centre_px[0] - width / 2}</cx>"
            f"<cy>{posed.centre_px[1] - height / 2}</cy></calibration></sensor>"
        )
        values = " ".join(map(str, to_chunk.ravel()))
        cameras += f'<camera id="{number}" sensor_id="{number}" label="{label}">'
        cameras += f"<transform>{values}</transform></camera>"
        for subject, take in takes.items():
            place = folder / label / take
            place.mkdir(parents=True)
            for frame, light in pairs:
                image = capture.frame(subject, name, light - 1) if light else np.ones((height, width, 3))
                stored = image @ np.linalg.inv(COLOURS).T * (0.5 if subject == dark else 1) + BLACK
                write_exr(place / f"{take}.{frame + 1:06d}.exr", stored.astype(np.float32))
    cameras += '<camera id="99" sensor_id="0" label="not aligned"/>'
    rotation = " ".join(map(str, _TURN.ravel()))
    transform = f"<rotation>{rotation}</rotation><scale>{_SCALE}</scale>"
    (folder / "calibration/cameras/001.xml").write_text(
        f'<?xml version="1.0"?><document version="1.2.0"><chunk label="one"><sensors>{sensors}</sensors>'
        f"<cameras>{cameras}</cameras><transform>{transform}</transform></chunk></document>"
    )
    return takes


def _write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
