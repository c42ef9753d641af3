"""The reflectance models that the paper compares with (paper, 'Light Estimation'); docs/baselines.md."""

from typing import Literal

# `--reflectance`: the paper's neural field, or one of the models that it is compared with.
Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]
