#!/usr/bin/env python
"""Put views of environment maps behind the synthetic people of a bank, besides the drawn backgrounds.

    python examples/add_backgrounds.py BANK MAP...

Run it once, before the bank is used. The last leg of the shipped Parsing Network saw six maps of Poly Haven
(CC0): kiara_1_dawn, potsdamer_platz, rooitou_park, st_fagans_interior, studio_small_03 and venice_sunset.
"""

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file

from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.light_files import read_map_file
from facerf_cli.synth.bank.backgrounds import BACKGROUND_HEAPS, BACKGROUND_MAPS, load_backgrounds, views_of

VIEWS = 16  # of each map
SEED = 15

bank = Path(sys.argv[1])
generator = torch.Generator().manual_seed(SEED)
seen = [views_of(read_map_file(name), VIEWS, generator) for name in sys.argv[2:]]
path = bank / "drawn_backgrounds.safetensors"
drawn = load_backgrounds(path, BACKGROUND_MAPS, BACKGROUND_HEAPS, SEED)
with atomic_path(bank / "backgrounds.safetensors") as path:
    save_file({"backgrounds": torch.cat([drawn, *seen])}, path)
