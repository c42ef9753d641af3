"""The header of a JPEG XL (ISO/IEC 18181-1, 'Image headers'), for what OpenImageIO leaves out."""

from pathlib import Path

from facerf_cli.files.avif import boxes

_HEADER_BYTES = 4096  # more than one has
_ALPHA = 0  # as the kind of an extra channel


def multiplies_alpha(path: Path) -> bool:
    """Return whether the colour is multiplied by alpha; False for the header of an animation or a preview."""
    content = path.read_bytes()
    if not content.startswith(b"\xff\x0a"):  # in a container, whole or in numbered parts
        parts = [body[4 * (kind == b"jxlp") :] for kind, body in boxes(content) if kind in (b"jxlc", b"jxlp")]
        content = b"".join(parts)
    rest = int.from_bytes(content[2:_HEADER_BYTES], "little")  # zeros follow it

    def read(count: int) -> int:
        nonlocal rest
        value, rest = rest & ((1 << count) - 1), rest >> count
        return value

    def choose(*choices: tuple[int, int]) -> int:
        """Read a number of so many bits above an offset; two bits say which."""
        count, offset = choices[read(2)]
        return offset + read(count)

    def skip_size() -> None:
        is_small = read(1)
        for skips_ratio in (True, False):
            if is_small:
                read(5)
            else:
                choose((9, 1), (13, 1), (18, 1), (30, 1))
            if skips_ratio and read(3):  # by which the width follows
                return

    def skip_depth() -> None:
        if read(1):  # floats
            choose((0, 32), (0, 16), (0, 24), (6, 1))
            read(4)
        else:
            choose((0, 8), (0, 10), (0, 12), (6, 1))

    skip_size()
    if read(1):  # all is as by default, without alpha
        return False
    if read(1):  # extra fields
        read(3)  # orientation
        if read(1):
            skip_size()
        if read(2):  # a preview, an animation
            return False
    skip_depth()
    read(1)
    if not choose((0, 0), (0, 1), (4, 2), (12, 1)) or read(1):  # no extra channel, or alpha as by default
        return False
    kind = choose((0, 0), (0, 1), (4, 2), (6, 18))
    skip_depth()
    choose((0, 0), (0, 3), (0, 4), (3, 1))
    read(8 * choose((0, 0), (4, 0), (5, 16), (10, 48)))  # its name
    return kind == _ALPHA and read(1) == 1
