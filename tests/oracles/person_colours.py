"""The slow twin of `portrait.matte.PersonColours`: all pixels at once."""

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.portrait.matte import _COLOUR_REACH, _unmixed, weighted_mean


def slow_person_colours(photo: np.ndarray, matte: np.ndarray, most_px: int) -> np.ndarray:
    """The person's own colours [H, W, 3] in a photo, of which a matte [H, W] is the person's share."""
    scale = min(1.0, most_px / max(matte.shape))
    size = [max(1, round(side * scale)) for side in matte.shape]
    both = torch.from_numpy(np.dstack([photo, matte])).permute(2, 0, 1)[None]
    small = F.interpolate(both, size, mode="area")[0].permute(1, 2, 0).numpy()
    seen, share = small[..., :3], small[..., 3]
    person = own = background = seen
    for reach in _COLOUR_REACH:
        span = max(3, 2 * round(reach * max(size)) + 1)
        own = weighted_mean(person, share, span)
        background = weighted_mean(background, 1 - share, span)
        person = _unmixed(seen, share, own, background)
    means = torch.from_numpy(np.dstack([own, background])).permute(2, 0, 1)[None]
    wide = F.interpolate(means, matte.shape, mode="bilinear")[0].permute(1, 2, 0).numpy()
    share = matte[..., None]
    found = _unmixed(photo, matte, wide[..., :3], wide[..., 3:])
    left = 0.7 * (1 - share) * np.minimum(wide[..., 3:], photo)  # of the background nearby
    most = np.divide(photo - left, share, out=np.zeros_like(photo), where=share > 0)
    return np.minimum(np.where(share > 0, found, 0), most)
