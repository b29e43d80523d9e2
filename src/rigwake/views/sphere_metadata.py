"""Marks pictures and videos as spheres, so that players and phones show them as such.

Pictures: the XMP packet GPano (Google, *Photo Sphere XMP Metadata*), in an `APP1` segment of a JPEG or an `iTXt` chunk
of a PNG. Videos: Spherical Video V1 (a `uuid` box with RDF in the video track) and V2 (boxes `st3d` and `sv3d` in the
sample entry), Google, *Spherical Video RFC* and *Spherical Video V2 RFC*.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from rigwake.errors import InputError

_V1_UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"udta", b"edts", b"dinf")


def gpano_packet(width_px: int, height_px: int) -> bytes:
    """The XMP packet of a full equirectangular picture."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/">'
        "<GPano:UsePanoramaViewer>True</GPano:UsePanoramaViewer>"
        "<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
        f"<GPano:FullPanoWidthPixels>{width_px}</GPano:FullPanoWidthPixels>"
        f"<GPano:FullPanoHeightPixels>{height_px}</GPano:FullPanoHeightPixels>"
        f"<GPano:CroppedAreaImageWidthPixels>{width_px}</GPano:CroppedAreaImageWidthPixels>"
        f"<GPano:CroppedAreaImageHeightPixels>{height_px}</GPano:CroppedAreaImageHeightPixels>"
        "<GPano:CroppedAreaLeftPixels>0</GPano:CroppedAreaLeftPixels>"
        "<GPano:CroppedAreaTopPixels>0</GPano:CroppedAreaTopPixels>"
        "<GPano:PoseHeadingDegrees>0</GPano:PoseHeadingDegrees>"
        "<GPano:InitialViewHeadingDegrees>0</GPano:InitialViewHeadingDegrees>"
        '</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def mark_picture(encoded: bytes, width_px: int, height_px: int) -> bytes:
    """An encoded JPEG or PNG with the packet put in. InputError for any other format."""
    packet = gpano_packet(width_px, height_px)
    if encoded[:2] == b"\xff\xd8":
        body = _XMP_HEADER + packet
        return encoded[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + encoded[2:]
    if encoded[:8] == b"\x89PNG\r\n\x1a\n":
        end = 8 + 12 + struct.unpack(">I", encoded[8:12])[0]  # after IHDR
        data = b"XML:com.adobe.xmp\x00\x00\x00\x00\x00" + packet
        chunk = b"iTXt" + data
        framed = struct.pack(">I", len(data)) + chunk + struct.pack(">I", zlib.crc32(chunk))
        return encoded[:end] + framed + encoded[end:]
    raise InputError("Only JPEG and PNG pictures can be marked as spheres.")


def spherical_v1_box(software: str = "rigwake") -> bytes:
    """The `uuid` box of Spherical Video V1, monoscopic equirectangular."""
    xml = (
        '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
        'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
        "<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true</GSpherical:Stitched>"
        f"<GSpherical:StitchingSoftware>{software}</GSpherical:StitchingSoftware>"
        "<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"
    ).encode()
    return _box(b"uuid", _V1_UUID + xml)


def spherical_v2_boxes(software: str = "rigwake") -> bytes:
    """The boxes `st3d` (monoscopic) and `sv3d` (equirectangular, uncropped) of Spherical Video V2."""
    full = b"\x00\x00\x00\x00"
    st3d = _box(b"st3d", full + b"\x00")
    svhd = _box(b"svhd", full + software.encode() + b"\x00")
    prhd = _box(b"prhd", full + struct.pack(">iii", 0, 0, 0))
    equi = _box(b"equi", full + struct.pack(">IIII", 0, 0, 0, 0))
    return st3d + _box(b"sv3d", svhd + _box(b"proj", prhd + equi))


def mark_video(path: Path) -> None:
    """Put the metadata of both versions into an MP4 whose `moov` comes after its `mdat` (so that nothing moves).

    Raises InputError if the file has no `moov` box at its end.
    """
    boxes = _top_level(path)
    if not boxes or boxes[-1][0] != b"moov":
        raise InputError(f"{path} is not an MP4 with its index at the end.")
    _, start, size = boxes[-1]
    with path.open("r+b") as file:
        file.seek(start)
        moov = file.read(size)
        file.seek(start)
        file.write(_marked_moov(moov))
        file.truncate()


def _top_level(path: Path) -> list[tuple[bytes, int, int]]:
    """Kind, start and size of the boxes of a file."""
    boxes, at, end = [], 0, path.stat().st_size
    with path.open("rb") as file:
        while at + 8 <= end:
            file.seek(at)
            head = file.read(16)
            size = struct.unpack(">I", head[:4])[0]
            if size == 1 and len(head) == 16:
                size = struct.unpack(">Q", head[8:16])[0]
            elif size == 0:
                size = end - at
            if size < 8 or at + size > end:
                break
            boxes.append((head[4:8], at, size))
            at += size
    return boxes


def _children(content: bytes) -> list[tuple[bytes, bytes]]:
    """Kind and content of the boxes that follow one another in bytes."""
    found, at = [], 0
    while at + 8 <= len(content):
        size = struct.unpack(">I", content[at : at + 4])[0]
        if size < 8 or at + size > len(content):
            break
        found.append((content[at + 4 : at + 8], content[at + 8 : at + size]))
        at += size
    return found


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content) + 8) + kind + content


def _marked_moov(moov: bytes) -> bytes:
    parts = []
    for kind, content in _children(moov[8:]):
        if kind == b"trak" and b"vide" in content:
            parts.append(_box(kind, _marked(content) + spherical_v1_box()))
        else:
            parts.append(_box(kind, content))
    return _box(b"moov", b"".join(parts))


def _marked(content: bytes) -> bytes:
    """A container's content with the boxes of V2 at the end of every visual sample entry."""
    parts = []
    for kind, inner in _children(content):
        if kind == b"stsd":
            entries = b"".join(_box(k, c + spherical_v2_boxes()) for k, c in _children(inner[8:]))
            parts.append(_box(kind, inner[:8] + entries))
        elif kind in _CONTAINERS:
            parts.append(_box(kind, _marked(inner)))
        else:
            parts.append(_box(kind, inner))
    return b"".join(parts)
