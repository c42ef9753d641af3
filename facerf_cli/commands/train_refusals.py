"""Options of `facerf train` that make no sense together, each refused in a line."""

from typing import TYPE_CHECKING

from facerf_cli.commands.options import flag, was_given
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    import typer

_IN_CHART = ("reflectance", "light-features", "diffuse-sh")  # stages that learn from textures alone
_STAGES = {  # that an option means something to
    "vgg_weights": ("joint",),
    "photos": ("joint",),
    "light_features": ("joint", "reflectance"),
    "without_normals": ("joint", "reflectance"),
    "mean_face": ("joint", "reflectance"),
    "views": _IN_CHART,
    "texture_size": _IN_CHART,
    "dataset": (*_IN_CHART, "joint"),
    "fit_with": _IN_CHART,
    "heads_from": (*_IN_CHART, "geometry"),
    "heads": (*_IN_CHART, "geometry"),
    "bank": (*_IN_CHART, "geometry"),
}


def refuse_what_makes_no_sense(context: "typer.Context", stage: str) -> None:
    """UsageError for what was given although it means nothing beside the rest of the line."""
    given = {name for name in context.params if was_given(context, name)}
    for name, stages in _STAGES.items():
        if name in given and stage not in stages:
            raise UsageError(f"{flag(name)} means nothing to the stage {stage}; leave it out")
    if stage == "joint" and "dataset" not in given:
        raise UsageError("the stage joint learns from a prepared dataset; give --dataset")
    for name in ("heads_from", "heads", "views", "bank"):
        if {name, "dataset"} <= given:
            raise UsageError(
                f"{flag(name)} is for synthetic heads, and --dataset takes their place; give one of them"
            )
    if "texture_size" in given and "dataset" not in given:
        raise UsageError("--texture-size is for a prepared dataset; give --dataset beside it")
    if {"mean_face", "dataset"} <= given and stage == "reflectance":
        raise UsageError("--mean-face: a dataset was fitted already; give --stage joint, or synthetic heads")
    if {"without_normals", "start_from"} <= given:
        raise UsageError("--without-normals: the networks of --start-from are as they are; give one of them")
