"""Commands that accept the global options anywhere, whose `--help` shows only everyday options and examples.

`--help-all` shows every option. Everyday options are those that `option.py` marks so, those that a command
declares itself, and those that its examples use.
"""

from copy import copy
from typing import TYPE_CHECKING, Any

import typer

_ALL = "--help-all"  # also in the `meta` of a call
_EXAMPLES = """
facerf demo
facerf relight me.jpg --light 40,20 -o relit.png
facerf relight photos/ --envmap skies/ --rotate 0:360:24 -o relit/
facerf view me.jpg -o me.html
facerf view stacks/me_olat.exr -o me.html
facerf estimate-light me.jpg -o light.exr
facerf estimate-light shot.mp4 -o light/
facerf predict-olat me.jpg -o stacks/
facerf predict-olat me.jpg --lights '40,20;-40,20' --frame uv -o stacks/
facerf segment me.jpg -o cut.png
facerf segment group.jpg --face all -o cut/
facerf fit-geometry me.jpg -o me.glb
facerf fit-geometry photos/ --landmarks points/ -o fit/
facerf envmap --count 20 -o maps/
facerf envmap --kind sun --seed 3 -o maps/
facerf synth-stage --subjects 40 --lights 64 --jobs 2 -o capture/
facerf prepare-dataset capture/ --describe
facerf prepare-dataset capture/ --split 0.8/0.1/0.1 --jobs 2 -o dataset/
facerf relight-dataset dataset/ --envmaps skies/
facerf relight-dataset dataset/ --envmaps procedural:500 --per-subject 1000 --lazy
facerf train --dataset dataset/ -o run/ --max-time 2h
facerf train -o run/ --resume
facerf doctor
facerf doctor --checkpoint run/
facerf evaluate olat dataset/ -o report/
facerf evaluate olat dataset/ --against other.safetensors -o report/
facerf evaluate reconstruction photos/ -o report/
facerf evaluate reconstruction photos/ --reflectance prt -o report/
facerf evaluate transfer photos/ -o report/
facerf evaluate transfer dataset/ --reflectance field --reflectance prt -o report/
facerf evaluate geometry photos/ -o report/
facerf evaluate geometry photos/ --face-model ict.npz -o report/
facerf evaluate yale-b CroppedYale/ -o report/
facerf evaluate yale-b CroppedYale/ --checkpoint run/ --reflectance field -o report/
facerf evaluate cases dataset/ -o cases/
facerf evaluate cases dataset/ --split all --every 10 --same-pose -o cases/
facerf evaluate compare cases/ --reflectance field --method theirs=renders/ -o report/
facerf evaluate compare truth/ --method mine/ --method theirs/ --masks masks/ -o report/
facerf face-model import ICT-FaceKit.zip -o ict.npz
facerf face-model import flame.pkl --landmarks embedding.npy -o flame.npz
"""


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


def examples_of(command: str) -> list[str]:
    """Return the examples of a command, such as `evaluate olat`."""
    return [line for line in _EXAMPLES.splitlines() if f"{line} ".startswith(f"facerf {command} ")]


def epilog_of(command: str, notes: str) -> str:
    """Return the end of a command's help: notes, and its examples, whose lines stay apart."""
    return "\n".join([notes, "", "\b", "EXAMPLES", *(f"  {line}" for line in examples_of(command))])
