"""The help of a verb of many options: `--help` shows those of everyday use, `--help-all` every one.

Of everyday use is what `option.py` marks so, what a verb declares for itself, and what its examples use.
"""

from typing import TYPE_CHECKING, Any

import typer

_ALL = "--help-all"  # also in the `meta` of a call


class _Brief(Any if TYPE_CHECKING else object):  # type: ignore[misc]
    """A command whose function's `everyday` names the options that `--help` shows; without it, all."""

    params: list[Any]
    epilog: str | None

    def get_help_option_names(self, ctx: Any) -> list[str]:
        """The names of the option that prints the help."""
        return ["-h", "--help", _ALL]

    def get_help_option(self, ctx: Any) -> Any:
        """The option that prints the help."""
        option = super().get_help_option(ctx)
        option.help = f"Show this help and exit; {_ALL}: with all options."
        return option

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note which help is wanted, and parse."""
        ctx.meta[_ALL] = _ALL in args
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, and how to see the options that it leaves out."""
        params, epilog = self.params, self.epilog or ""
        everyday, used = getattr(self.callback, "everyday", None), set(epilog.split())
        if everyday is not None and not ctx.meta.get(_ALL):
            self.params = [one for one in params if one.name in everyday or not used.isdisjoint(one.opts)]
            path, left_out = ctx.command_path, len(params) - len(self.params)
            more = f"{left_out} more options: {path} {_ALL}, or man {path.replace(' ', '-')}."
            self.epilog = f"{more}\n\n{epilog}".rstrip()
        super().format_help(ctx, formatter)
        self.params, self.epilog = params, epilog


class Verb(_Brief, typer.core.TyperCommand):
    """A verb."""


class Verbs(_Brief, typer.core.TyperGroup):
    """A group of verbs."""
