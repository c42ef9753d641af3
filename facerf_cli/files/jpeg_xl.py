"""The header of a JPEG XL (ISO/IEC 18181-1, 'Image headers'), for what OpenImageIO leaves out."""

from pathlib import Path

from facerf_cli.files.avif import boxes

_HEADER_BYTES = 4096  # more than one has
_ALPHA, _SPOT, _FILTERS = 0, 2, 5  # kinds of extra channels
_PREVIEW_SIDE = (6, 1), (8, 65), (10, 321), (12, 1345)
_PREVIEW_EIGHTHS = (0, 16), (0, 32), (5, 1), (9, 33)


class _Bits:
    """Numbers of a header, from its lowest bit; zeros follow its end."""

    def __init__(self, content: bytes) -> None:
        self._rest = int.from_bytes(content, "little")

    def read(self, count: int) -> int:
        value = self._rest & ((1 << count) - 1)
        self._rest >>= count
        return value

    def choose(self, *choices: tuple[int, int]) -> int:
        """Read a number of so many bits above an offset; two bits choose which."""
        count, offset = choices[self.read(2)]
        return offset + self.read(count)

    def skip_size(self) -> None:
        is_small = self.read(1)
        self._skip_side(is_small)
        if self.read(3) == 0:  # the width does not follow by a ratio
            self._skip_side(is_small)

    def _skip_side(self, is_small: int) -> None:
        if is_small:
            self.read(5)
        else:
            self.choose((9, 1), (13, 1), (18, 1), (30, 1))

    def skip_depth(self) -> None:
        if self.read(1):  # floats
            self.choose((0, 32), (0, 16), (0, 24), (6, 1))
            self.read(4)
        else:
            self.choose((0, 8), (0, 10), (0, 12), (6, 1))


def multiplies_alpha(path: Path) -> bool:
    """Return whether the colour is multiplied by alpha."""
    content = path.read_bytes()
    if not content.startswith(b"\xff\x0a"):  # in a container, whole or in numbered parts
        parts = [body[4 * (kind == b"jxlp") :] for kind, body in boxes(content) if kind in (b"jxlc", b"jxlp")]
        content = b"".join(parts)
    bits = _Bits(content[2:_HEADER_BYTES])
    bits.skip_size()
    if bits.read(1):  # all is as by default, without alpha
        return False
    if bits.read(1):
        _skip_extra_fields(bits)
    bits.skip_depth()
    bits.read(1)
    for _ in range(bits.choose((0, 0), (0, 1), (4, 2), (12, 1))):
        if bits.read(1):  # alpha as by default
            return False
        kind = bits.choose((0, 0), (0, 1), (4, 2), (6, 18))
        bits.skip_depth()
        bits.choose((0, 0), (0, 3), (0, 4), (3, 1))
        bits.read(8 * bits.choose((0, 0), (4, 0), (5, 16), (10, 48)))  # its name
        if kind == _ALPHA:
            return bool(bits.read(1))
        if kind == _SPOT:
            bits.read(4 * 16)
        elif kind == _FILTERS:
            bits.choose((0, 1), (2, 0), (4, 3), (8, 19))
    return False


def _skip_extra_fields(bits: _Bits) -> None:
    """Skip orientation, intrinsic size, preview and animation."""
    bits.read(3)
    if bits.read(1):
        bits.skip_size()
    if bits.read(1):
        side = _PREVIEW_EIGHTHS if bits.read(1) else _PREVIEW_SIDE
        bits.choose(*side)
        if bits.read(3) == 0:
            bits.choose(*side)
    if bits.read(1):
        bits.choose((0, 100), (0, 1000), (10, 1), (30, 1))
        bits.choose((0, 1), (0, 1001), (8, 1), (10, 1))
        bits.choose((0, 0), (3, 0), (16, 0), (32, 0))
        bits.read(1)
