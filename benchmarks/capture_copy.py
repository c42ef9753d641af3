"""A subject's frames of some cameras, copied with their description, to have faults planted in them."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.stage_json import STAGE_FILE
from facerf_cli.files.images import read_image

_IN_FRONT = 0.7  # cosine to the first camera's axis of the lamps whose frames are touched


class Copy:
    """A subject's frames of some cameras, copied, with their description; what is planted is planted here."""

    def __init__(self, source: Path, folder: Path, subject: str, cameras: int) -> None:
        text = json.loads((source / STAGE_FILE).read_text())
        text |= {"cameras": text["cameras"][:cameras], "subjects": {subject: {}}}
        self.folder, self.subject = folder, subject
        self.description: dict[str, Any] = text
        self.cameras = [camera["id"] for camera in text["cameras"]]
        self.ids = [light["id"] for light in text["lights"]]
        self.save()
        capture = read_capture(source)
        self._at = capture.frame_path
        turn = capture.cameras[self.cameras[0]].rotation.numpy()
        self.directions = capture.directions_world @ turn.T  # [L, 3], of the first camera
        for camera in self.cameras:
            for light in self.ids:
                to = self.path(light, camera)
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self._at(subject, camera, light), to)

    def save(self) -> None:
        """Write the description as it is now."""
        (self.folder / STAGE_FILE).write_text(json.dumps(self.description))

    def path(self, light: str, camera: str = "") -> Path:
        """A frame of the copy, of the first camera if none is named."""
        pattern: str = self.description["pattern"]
        names = {"subject": self.subject, "camera": camera or self.cameras[0], "light": light}
        return self.folder / pattern.format(**names)

    def read(self, light: str) -> np.ndarray:
        """A frame of the first camera [H, W, 3] as it was before anything was planted."""
        return read_image(self._at(self.subject, self.cameras[0], light), "linear").pixels

    def write(self, light: str, pixels: np.ndarray) -> None:
        """As a half float EXR, with whatever is in it; `write_exr` would refuse NaN."""
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
        buffer.set_write_format("half")
        buffer.write(str(self.path(light)))

    def front(self) -> list[str]:
        """Lights in front of the first camera, the most frontal first."""
        order = np.argsort(-self.directions[:, 2])
        return [self.ids[row] for row in order if self.directions[row, 2] > _IN_FRONT]

    def far(self, light: str) -> str:
        """The light in front that is furthest from another."""
        rows = [self.ids.index(other) for other in self.front()]
        return self.ids[
            min(rows, key=lambda row: self.directions[row] @ self.directions[self.ids.index(light)])
        ]

    def near(self, light: str) -> str:
        """The light nearest to another."""
        cosines = self.directions @ self.directions[self.ids.index(light)]
        return self.ids[int(np.argsort(-cosines)[1])]

    def found(self) -> list[Finding]:
        """What the checks say of the copy."""
        self.save()
        return check_subject(read_capture(self.folder), self.subject)
