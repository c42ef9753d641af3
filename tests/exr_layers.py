"""The channels of every part of an EXR, for tests."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio


def exr_layers(path: Path) -> dict[str, np.ndarray]:
    """Channels [H, W] by name, in the order of the parts; a name that is there twice is an error."""
    found: dict[str, np.ndarray] = {}
    for part in range(oiio.ImageBuf(str(path)).nsubimages):
        image = oiio.ImageBuf(str(path), part, 0)
        names, pixels = image.spec().channelnames, image.get_pixels(oiio.FLOAT)
        assert not set(names) & set(found)
        found |= {name: pixels[..., index] for index, name in enumerate(names)}
    return found
