"""Classes that the Parsing Network tells apart in a photo of a person, and landmarks beyond the 68."""

CLASSES = (
    "background",
    "skin",
    "brows",
    "eyes",
    "lips",
    "mouth",
    "hair",
    "beard",
    "ears",
    "neck",
    "glasses",
    "headwear",
    "garment",
    "hand",
)
IRIS_POINTS = 8  # on the outline of an iris, from its right end counter-clockwise
MORE_LANDMARKS = tuple(
    f"{side} {name}"
    for side in ("left", "right")  # of the image
    for name in ("iris", *(f"iris {k}" for k in range(IRIS_POINTS)), "ear top", "ear lobe", "ear back")
)


def class_index(name: str) -> int:
    """Index of a class."""
    return CLASSES.index(name)


def mirrored_landmarks() -> tuple[int, ...]:
    """Index of the landmark of `MORE_LANDMARKS` that each one becomes in a mirrored image."""
    return tuple(MORE_LANDMARKS.index(_mirrored(name)) for name in MORE_LANDMARKS)


def _mirrored(name: str) -> str:
    side, part, *point = name.split(" ")
    if part == "iris" and point:
        point = [str((IRIS_POINTS // 2 - int(point[0])) % IRIS_POINTS)]
    return " ".join(["left" if side == "right" else "right", part, *point])
