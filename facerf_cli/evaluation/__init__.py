"""Protocols, metrics and reports of `facerf evaluate`."""
