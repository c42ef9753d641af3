"""The names of the reflectance models, without what it takes to run them."""

from typing import Literal

Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]
