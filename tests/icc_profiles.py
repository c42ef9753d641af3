"""ICC profiles for tests, built tag by tag from published numbers (ICC.1:2022)."""

import struct
from collections.abc import Mapping, Sequence

# Colorants under D50 and the curve of Apple's Display P3 profile.
_P3_COLORANTS = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))
_SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
# Of ProPhoto RGB, whose profiles have a plain power of 1.8.
_PROPHOTO_COLORANTS = ((0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.03134, 0.00009, 0.82491))


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def parametric(kind: int, *parameters: float) -> bytes:
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + fixed(*parameters)


def sampled(*entries: int) -> bytes:
    return b"curv" + bytes(4) + struct.pack(f">I{len(entries)}H", len(entries), *entries)


def profile(
    tags: Mapping[bytes, bytes], kind: bytes = b"RGB ", made_for: bytes = b"mntr", connection: bytes = b"XYZ "
) -> bytes:
    """A profile (version 4) with these tags."""
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    header = bytearray(128)
    header[8:12], header[12:24], header[36:40] = b"\x04\x30\0\0", made_for + kind + connection, b"acsp"
    header[68:80] = fixed(0.9642, 1.0, 0.8249)
    whole = bytes(header) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(whole)) + whole[4:]


def described(name: str) -> dict[bytes, bytes]:
    """The tags that every profile has."""
    text = name.encode("utf-16-be")
    content = b"mluc" + bytes(4) + struct.pack(">II4sII", 1, 12, b"enUS", len(text), 28) + text
    return {b"desc": content, b"cprt": content, b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)}


def grey_profile(name: str, curve: bytes, connection: bytes = b"XYZ ") -> bytes:
    return profile({**described(name), b"kTRC": curve}, b"GRAY", connection=connection)


def rgb_profile(name: str, colorants: Sequence[Sequence[float]], curve: bytes) -> bytes:
    tags = described(name)
    for letter, colorant in zip((b"r", b"g", b"b"), colorants, strict=True):
        tags |= {letter + b"XYZ": b"XYZ " + bytes(4) + fixed(*colorant), letter + b"TRC": curve}
    return profile(tags)


def press_profile() -> bytes:
    """A profile of inks, a table of 2^4 corners: cyan halves L*, black removes it, others print nothing."""
    corners = [(50 if cyan else 100) * (1 - black) for cyan in (0, 1) for _ in range(4) for black in (0, 1)]
    table = b"".join(bytes([round(lightness * 2.55), 128, 128]) for lightness in corners)
    ramp, unit = bytes(range(256)), fixed(1, 0, 0, 0, 1, 0, 0, 0, 1)
    content = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + unit + 4 * ramp + table + 3 * ramp
    return profile({**described("press"), b"A2B0": content}, b"CMYK", b"prtr", b"Lab ")


def scanner_profile() -> bytes:
    """A profile of RGB by a table of 2^3 corners in Lab."""
    corners = [(5 + 30 * r + 50 * g + 15 * b, 60 * (r - g), 40 * (g - b))
               for r in (0, 1) for g in (0, 1) for b in (0, 1)]  # fmt: skip
    table = b"".join(bytes([round(light * 2.55), 128 + a, 128 + b]) for light, a, b in corners)
    ramp, unit = bytes(range(256)), fixed(1, 0, 0, 0, 1, 0, 0, 0, 1)
    content = b"mft1" + bytes(4) + bytes([3, 3, 2, 0]) + unit + 3 * ramp + table + 3 * ramp
    return profile({**described("Scanner 9"), b"A2B0": content}, b"RGB ", b"scnr", b"Lab ")


DISPLAY_P3 = rgb_profile("Display P3", _P3_COLORANTS, parametric(3, *_SRGB_CURVE))
PROPHOTO = rgb_profile("ProPhoto RGB", _PROPHOTO_COLORANTS, sampled(461))  # 1.8 in 256ths
