"""The reflectance models with which the paper compares ('Light Estimation'); see docs/paper.md."""

from typing import Literal

# Models of a face: the paper's neural field, or one that it is compared with.
Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]
# Models that relight a photo: of the whole portrait, or of its face.
RelightKind = Literal["portrait", "field", "diffuse-sh", "specular-sh", "prt"]
