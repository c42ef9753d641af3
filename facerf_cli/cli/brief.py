"""Commands that accept the global options anywhere, and whose `--help` shows only everyday options.

`--help-all` shows every option. Everyday options are those that `option.py` marks so, those that a command
declares itself, and those that its examples use.
"""

from copy import copy
from typing import TYPE_CHECKING, Any

import typer

_ALL = "--help-all"  # also in the `meta` of a call


class _Brief(Any if TYPE_CHECKING else object):  # type: ignore[misc]
    """A command; if its function has `everyday`, `--help` shows only these options."""

    params: list[Any]
    epilog: str | None

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, and hidden ones for the global options, which may follow the command."""
        root = ctx.find_root().command
        return [*super().get_params(ctx), *(_hidden(option) for option in root.params if root is not self)]

    def get_help_option_names(self, ctx: Any) -> list[str]:
        """Return the names of the option that prints the help."""
        return ["-h", "--help", _ALL]

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option that prints the help."""
        option = super().get_help_option(ctx)
        option.help = f"Show this help and exit; {_ALL}: with all options."
        return option

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse, note which help is requested, and apply global options that follow the command."""
        ctx.meta[_ALL] = _ALL in args
        rest: list[str] = super().parse_args(ctx, args)
        root, is_changed = ctx.find_root(), False
        for option in root.command.params if ctx is not root else ():
            value, source = ctx.params.pop(option.name, None), ctx.get_parameter_source(option.name)
            if source.name == "COMMANDLINE":
                root.params[option.name], is_changed = value, True
                root.set_parameter_source(option.name, source)
        if is_changed and not ctx.resilient_parsing:  # of a shell that completes a line
            root.invoke(root.command.callback, **root.params)
        return rest

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, and how to show the options that it omits."""
        params, epilog = self.params, self.epilog or ""
        everyday, used = getattr(self.callback, "everyday", None), set(epilog.split())
        if everyday is not None and not ctx.meta.get(_ALL):
            self.params = [one for one in params if one.name in everyday or not used.isdisjoint(one.opts)]
            path, omitted = ctx.command_path, len(params) - len(self.params)
            more = f"{omitted} more options: {path} {_ALL}, or man {path.replace(' ', '-')}."
            self.epilog = f"{more}\n\n{epilog}".rstrip()
        super().format_help(ctx, formatter)
        self.params, self.epilog = params, epilog


def _hidden(option: Any) -> Any:
    hidden = copy(option)
    hidden.hidden, hidden.envvar = True, None  # which the root has read
    return hidden


class Verb(_Brief, typer.core.TyperCommand):
    """A command."""


class Verbs(_Brief, typer.core.TyperGroup):
    """A group of commands."""
