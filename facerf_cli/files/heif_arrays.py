"""HEIC and HEIF photos as arrays, by pi-heif, which some damaged files crash.

`heif` runs this in a process of its own (`files/apart.py`).
"""

from pathlib import Path

import numpy as np

PIXELS, PROFILE, CODES, SIZE = "pixels", "profile", "codes", "size"


def heif_arrays(path: Path, limit_px: int, most_px: int) -> dict[str, np.ndarray]:
    """The main image, upright, [H, W, C] uint8 or uint16, and its ICC profile or its colour's code points.

    Of an image of more than `most_px` pixels only the size (W, H); over `limit_px` is a ValueError.
    """
    import pi_heif

    image = pi_heif.open_heif(path, convert_hdr_to_8bit=False)
    width, height = image.size
    if width * height > limit_px:
        most = f"at most {limit_px / 1e6:.0f} megapixels are read"
        raise ValueError(f"{width} x {height} pixels; {most}, so make it smaller")
    if width * height > most_px:
        return {SIZE: np.array([width, height])}
    pixels = np.array(image)  # a copy: the memory of pi-heif ends with its image
    arrays = {PIXELS: pixels.reshape(height, width, -1)}
    if profile := image.info.get("icc_profile"):
        arrays[PROFILE] = np.frombuffer(profile, np.uint8)
    elif code := image.info.get("nclx_profile"):
        arrays[CODES] = np.array([code["color_primaries"], code["transfer_characteristics"]])
    return arrays
