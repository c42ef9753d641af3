"""Mean of the weights of two legs of a training, with the notes of the second but for its metrics.

    python examples/mean_of_checkpoints.py FIRST.safetensors SECOND.safetensors OUT.safetensors [SHARE]

SHARE is that of the second leg, by default a half. It must have started from the first: weights of trainings
apart have no useful mean.
"""

import sys
from pathlib import Path

from facerf_cli.network.checkpoint import load_checkpoint, save_checkpoint

first, second, out = map(Path, sys.argv[1:4])
share = float(sys.argv[4]) if len(sys.argv) > 4 else 0.5
before, _ = load_checkpoint(first)
after, metadata = load_checkpoint(second)
metadata.pop("metrics", None)
mean = {name: (1 - share) * before[name] + share * tensor for name, tensor in after.items()}
save_checkpoint(out, mean, metadata | {"weights": f"mean of two legs, {share:g} of the last"})
