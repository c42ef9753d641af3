"""Write a Nuke group that weighs the layers of an EXR by sliders and adds them up.

    python integrations/nuke/make_gizmo.py me_olat.exr facerf_stack.nk

The EXR is an OLAT stack of `facerf predict-olat` (layers light000, light001, ...) or an image of
`facerf relight --light NAME=...` (layers NAME). Insert the .nk in Nuke below a Read of the same EXR.
Of an OLAT stack with many lights, `--every N` keeps each Nth.
"""

import argparse
import re
from pathlib import Path

import OpenImageIO as oiio

_OTHERS = ("albedo", "specular", "shadow", "normal", "position")  # layers that are no lights


def layers_of(path: Path) -> list[str]:
    """Names of the lights in an EXR, in its order: parts of a stack, or layers of one part."""
    first = oiio.ImageBuf(str(path))
    if first.has_error:
        raise SystemExit(f"{path}: cannot be read: {first.geterror()}")
    parts = [oiio.ImageBuf(str(path), index, 0).spec() for index in range(first.nsubimages)]
    names = [str(spec.getattribute("oiio:subimagename") or "") for spec in parts]
    lights = [name for name in names if re.fullmatch(r"light\d+", name)]
    layers = list(zip(names, parts, strict=True))[1:]  # after the image itself
    return lights or [name for name, spec in layers if spec.nchannels == 3 and name not in _OTHERS]


def group(layers: list[str], name: str = "facerf_stack") -> str:
    """The text of a Nuke group with a slider and a colour for each layer."""
    lines = ["Group {", f" name {name}", " addUserKnob {20 facerf}"]
    for layer in layers:
        lines += [f" addUserKnob {{18 {layer} R 0 4}}", f" {layer} {{1 1 1}}"]
    lines += ["}", " Input {", "  inputs 0", "  name stack", " }", "set stack [stack 0]"]
    for number, layer in enumerate(layers):
        lines += ["push $stack"] if number else []
        lines += [" Shuffle {", f"  in {layer}", f"  name pick_{layer}", " }"]
        weights = " ".join(f"{{parent.{layer}.{channel}}}" for channel in "rgb")
        lines += [" Multiply {", "  channels rgb", f"  value {{{weights} 1}}", f"  name weigh_{layer}", " }"]
        if number:
            lines += [" Merge2 {", "  inputs 2", "  operation plus", f"  name add_{layer}", " }"]
    return "\n".join([*lines, " Output {", "  name Output1", " }", "end_group", ""])


def main() -> None:
    """Read the layers and write the group."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stack", type=Path)
    parser.add_argument("group", type=Path)
    parser.add_argument("--every", type=int, default=1, metavar="N")
    options = parser.parse_args()
    layers = layers_of(options.stack)[:: max(1, options.every)]
    if not layers:
        raise SystemExit(f"{options.stack}: has no layers of lights; give an OLAT stack or lights with names")
    options.group.write_text(group(layers), encoding="utf-8")
    print(f"{options.group}: {len(layers)} layers")


if __name__ == "__main__":
    main()
