"""`--shard` and `--ray`, for every verb that walks folders."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from facerf_cli.commands.options import RayOption, Shard, ShardOption, settings_of

_AFTER, _ALSO = "jobs", "dry_run"  # by these a verb that walks folders is known


def with_machines(verb: Callable[..., Any]) -> Callable[..., Any]:
    """The verb with `--shard` and `--ray` after its `--jobs`; a verb that walks no folders stays as it is.

    They go where `run_items` finds them, into the verb's `Settings`, so that the verb need not know them.
    typer reads signatures, so the function that it gets has one that lists them.
    """
    own = inspect.signature(verb).parameters
    if not {_AFTER, _ALSO} <= own.keys():
        return verb

    def run(**values: Any) -> Any:
        context = values["context"]
        shard, ray = Shard.parse(values.pop("shard")), values.pop("ray")
        context.obj = replace(settings_of(context), shard=shard, ray=ray)
        if ray is not None and context.get_parameter_source(_AFTER).name == "DEFAULT":
            values[_AFTER] = 0  # as many as Ray has processors
        return verb(**values)

    kind = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter(name, kind, default=None, annotation=option)
        for name, option in (("shard", ShardOption), ("ray", RayOption))
    ]
    parameters = [parameter.replace(kind=kind) for parameter in own.values()]
    place = list(own).index(_AFTER) + 1
    parameters[place:place] = added
    as_typer_reads_it: Any = run
    as_typer_reads_it.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    return run
