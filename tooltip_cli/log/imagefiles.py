"""What JPEG and PNG files claim, read before a decoder allocates it.

Source: ITU-T T.81, annex B (markers and frame headers); PNG specification, "Datastream structure".
"""

from __future__ import annotations

import struct

_PNG = b"\x89PNG\r\n\x1a\n"
_CHUNK = struct.Struct(">I4s")
_NO_FRAME = (0xC4, 0xC8, 0xCC)  # among the frame headers' markers: tables and extensions


def declared_size(data: memoryview) -> tuple[int, int] | None:
    """Return width and height; None where it is no JPEG or PNG, or its parts do not fit in it."""
    beginning = bytes(data[: len(_PNG)])
    if beginning == _PNG:
        return _png_size(data)
    return _jpeg_size(data) if beginning.startswith(b"\xff\xd8") else None


def _png_size(data: memoryview) -> tuple[int, int] | None:
    size, place = None, len(_PNG)
    while place + _CHUNK.size <= len(data):
        length, kind = _CHUNK.unpack_from(data, place)
        start = place + _CHUNK.size
        if length > len(data) - start:
            return None  # a decoder would make room for it all the same
        if (kind == b"IHDR") != (size is None) or (kind == b"IHDR" and length < 8):
            return None
        if size is None:
            size = struct.unpack_from(">II", data, start)
        place = start + length + 4
    return size


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    place = 2
    while place + 9 <= len(data):
        if data[place] != 0xFF:
            return None
        marker = data[place + 1]
        if marker == 0xFF:  # padding
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        elif marker == 0x01 or 0xD0 <= marker <= 0xD9:  # stand alone
            place += 2
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None
