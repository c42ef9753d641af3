#!/usr/bin/env python3
"""Average a trained Portrait Network with the shipped one, as WiSE-FT does (Wortsman et al., 2022).

    python tools/mean_of_weights.py RUN/last.safetensors SHARE OUT.safetensors

SHARE, from 0 to 1, is that of the trained weights. A shipped network that does not see the scale of a square
counts as one that ignores it.
"""

import argparse
from pathlib import Path

import torch
from torch.nn.functional import pad

from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_networks, save_networks
from facerf_cli.relighting.models import load_models


def main() -> None:
    """Write the average."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("trained", type=Path)
    parser.add_argument("share", type=float)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    networks, metadata = load_networks(given.trained, LAYOUT_VERSION, ["portrait"])
    trained, shipped = networks["portrait"].state_dict(), load_models().networks.portrait.state_dict()
    for name, weights in trained.items():
        start = shipped[name]
        if start.shape != weights.shape:
            start = pad(start, (0, 0, 0, 0, 0, weights.shape[1] - start.shape[1]))
        weights.copy_(torch.lerp(start.float(), weights.float(), given.share))
    save_networks(given.out, networks, metadata)


if __name__ == "__main__":
    main()
