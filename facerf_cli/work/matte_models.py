"""The models of rembg, an extra, that may make a person's matte: places, licences, and the matte itself.

facerf downloads none of them: a model is one that lies in rembg's folder already. Light to import.
"""

import os
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from facerf_cli.errors import UsageError

_MAKER = "rembg:"
UNKNOWN = "unknown to facerf"
# Licences of weights, as their authors state them (docs/segmentation.md names where).
_LICENCES = {
    "u2net": "Apache-2.0",
    "u2netp": "Apache-2.0",
    "u2net_human_seg": "Apache-2.0",
    "bria-rmbg": "CC BY-NC 4.0, not for commercial use",
}


@dataclass(frozen=True)
class MatteModel:
    """A model of rembg, `matte_from` as it is typed, and its file."""

    matte_from: str
    matte_model: Path

    @property
    def name(self) -> str:
        """The name by which rembg knows it."""
        return self.matte_from.removeprefix(_MAKER)

    @property
    def licence(self) -> str:
        """The licence of its weights, in words."""
        return "MIT" if self.name.startswith("birefnet-") else _LICENCES.get(self.name, UNKNOWN)

    def facts(self) -> dict[str, str]:
        """Its entries in the report."""
        return {"model": self.matte_from, "licence": self.licence, "file": str(self.matte_model)}


def parse_matte_from(text: str) -> MatteModel:
    """Parse `--matte-from`; raises UsageError for a model that is not in rembg's folder."""
    name = text.removeprefix(_MAKER)
    if not text.startswith(_MAKER) or not name or Path(name).name != name:
        raise UsageError(
            f"--matte-from {text!r}: not a model; give rembg:NAME, such as rembg:u2net_human_seg"
        )
    places = _places(name)
    for path in places:
        if path.is_file():
            return MatteModel(text, path)
    raise UsageError(
        f"--matte-from {text}: {places[0]} is not there, and facerf downloads no model; fetch it with "
        f"`rembg d {name}`"
    )


def _places(name: str) -> list[Path]:
    """The paths at which rembg looks for a model: a folder for each, and the one folder of older versions."""
    data = os.environ.get("XDG_DATA_HOME")
    older = Path(os.environ.get("U2NET_HOME") or Path(data or "~") / ".u2net").expanduser()
    newer = os.environ.get("REMBG_HOME") or (Path(data) / "rembg" if data else "~/.rembg")
    home = older if os.environ.get("U2NET_HOME") else Path(newer).expanduser()
    return [home / "models" / name / f"{name}.onnx", older / f"{name}.onnx"]


def require_rembg(model: MatteModel) -> None:
    """Raise UsageError where rembg is not installed."""
    if find_spec("rembg") is None:
        raise UsageError(
            f"--matte-from {model.matte_from}: needs the package rembg; pip install 'facerf[rembg]', or give "
            "--person"
        )


def matte_by_rembg(image_srgb: Any, model: MatteModel) -> Any:
    """The matte [H, W] in 0..1 of what stands out in an sRGB uint8 image [H, W, 3]."""
    import numpy as np
    from rembg import remove

    mask = np.asarray(remove(image_srgb, session=_session(model), only_mask=True))
    return mask.astype(np.float32) / np.float32(255)


@cache
def _session(model: MatteModel) -> Any:
    """The session of a model, opened once a process."""
    from rembg import new_session

    # with a checksum, versions that look in one folder fetch a file that is not theirs again
    os.environ["MODEL_CHECKSUM_DISABLED"] = "1"
    return new_session(model.name)
