"""A first draft of `stage.json` for a folder of pictures: what they tell, and null where they do not.

Under "draft" it lists what was found, and what a person has to fill in and to check.
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from facerf_cli.stage.data.documents import is_name
from facerf_cli.stage.data.stage_file import STAGE_FORMAT
from facerf_cli.stage.draft.cameras import describe_camera
from facerf_cli.stage.draft.evidence import Evidence, look_into
from facerf_cli.stage.draft.notes import notes_on

_LONE_CAMERA, _LONE_SUBJECT = "C0", "subject"  # where neither names nor the folder have one


def draft_stage(folder: Path, suffixes: Collection[str]) -> dict[str, Any]:
    """The content of `stage.json`, its notes under "draft"; a UsageError where the folder is no capture."""
    evidence = look_into(folder, suffixes)
    content = _content(evidence, folder.resolve().name)
    return {"format": STAGE_FORMAT, "draft": notes_on(evidence, content), **content}


def _content(evidence: Evidence, folder_name: str) -> dict[str, Any]:
    frames, pattern = evidence.frames, evidence.naming.pattern
    alone = len(evidence.sights) == 1
    dark = frames.ambient.most_common(1)
    name = folder_name if is_name(folder_name) else _LONE_SUBJECT
    return {
        "colour_space": evidence.colour_space,
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": pattern,
        **({"ambient": pattern.replace("{light}", dark[0][0])} if dark else {}),
        "lights": [
            {"id": light, "direction": evidence.rig.directions.get(light), "intensity": [1.0, 1.0, 1.0]}
            for light in frames.ids("light")
        ],
        "cameras": [
            describe_camera(camera or _LONE_CAMERA, sight, alone) for camera, sight in evidence.sights.items()
        ],
        **({} if "{subject}" in pattern else {"subjects": {name: {}}}),
    }


def as_text(stage: Mapping[str, Any]) -> str:
    """JSON with a lamp, a camera and a note a line, for people to fill in."""
    lines = []
    for key, value in stage.items():
        if isinstance(value, list):
            entries = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in value)
            lines.append(f" {json.dumps(key)}: [\n{entries}\n ]")
        else:
            lines.append(f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"
