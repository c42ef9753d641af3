"""Settings of networks, checked as they come out of a checkpoint, and the bounds of their numbers."""

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter

Count = Annotated[int, Field(ge=1, le=4096)]
Side = Annotated[int, Field(ge=8, le=4096)]  # pixels or texels
Grid = Annotated[int, Field(ge=1, le=64)]
VggWidth = Annotated[float, Field(gt=0, le=4)]  # a share of the channels of VGG-16
Landmarks = Annotated[int, Field(ge=68, le=256)]
Classes = Annotated[int, Field(ge=2, le=256)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1, max_length=12)]
WidthsOfFour = Annotated[  # for group normalisation
    tuple[Annotated[int, Field(ge=4, le=512, multiple_of=4)], ...], Field(min_length=3, max_length=6)
]
Blocks = Annotated[tuple[Annotated[int, Field(ge=0, le=8)], ...], Field(min_length=3, max_length=6)]

Settings = TypeVar("Settings")


def settings_from(kind: type[Settings], metadata: Mapping[str, Any]) -> Settings:
    """Make the dataclass of a network's settings from its metadata; raises TypeError or ValueError."""
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    given = {name: value for name, value in metadata.items() if name != "form" or name in known}
    if unknown := sorted(given.keys() - known):
        raise TypeError(f"a network of this form has no {', '.join(unknown)}")
    return TypeAdapter(kind).validate_json(json.dumps(given), strict=True)  # strict JSON has lists for tuples
