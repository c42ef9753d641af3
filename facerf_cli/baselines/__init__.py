"""The reflectance models with which the paper compares ('Light Estimation'); see docs/baselines.md."""

from typing import Literal

# Values of `--reflectance`: the whole portrait, the paper's neural field of the face, or one of the models
# that the field is compared with.
Kind = Literal["portrait", "field", "diffuse-sh", "specular-sh", "prt"]
