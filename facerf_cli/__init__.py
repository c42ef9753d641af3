"""facerf: one photo of a face to its reflectance field."""

__version__ = "0.1.0"
