"""`facerf doctor`: what is installed and what it may be used for, on one screen."""


def doctor() -> None:
    """Say what is installed, which device, assets and licences, and which colour configuration."""
