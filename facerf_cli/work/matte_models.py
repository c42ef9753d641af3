"""The models of rembg, an extra, that may make a person's matte: where they lie, their licences.

facerf downloads none of them: a model is one that lies in rembg's folder already. Light to import.
"""

import os
from dataclasses import dataclass
from pathlib import Path

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
