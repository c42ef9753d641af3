"""Mean of the weights of two legs of a training, with the notes of the second but for its metrics.

    python examples/mean_of_checkpoints.py FIRST.safetensors SECOND.safetensors OUT.safetensors

The second leg must have started from the first: weights of trainings apart have no useful mean.
"""

import sys
from pathlib import Path

from facerf_cli.network.checkpoint import load_checkpoint, save_checkpoint

first, second, out = map(Path, sys.argv[1:])
before, _ = load_checkpoint(first)
after, metadata = load_checkpoint(second)
del metadata["metrics"]
mean = {name: (before[name] + tensor) / 2 for name, tensor in after.items()}
save_checkpoint(out, mean, metadata | {"weights": "mean of the last two legs"})
