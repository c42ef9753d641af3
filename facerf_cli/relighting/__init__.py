from typing import Literal

White = Literal["photo", "scene"]  # of skin under even white light: as in the photo, or without its light
