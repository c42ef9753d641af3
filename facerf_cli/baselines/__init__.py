"""The reflectance models with which the paper compares ('Light Estimation'); see docs/baselines.md."""

from typing import Literal

# Values of `--reflectance`: the paper's neural field, or one of the models that it is compared with.
Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]
