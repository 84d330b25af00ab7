"""Which GDAL driver may open a map: found from its first bytes, one driver, named.

GDAL left to itself tries all its drivers, among them some that fetch from the network or open
further files (VRT, WMS, ...). A map from an untrusted place must not choose them.
"""

from __future__ import annotations

import re
from pathlib import Path

from frontends.errors import InputError

_HEAD_BYTES = 4096
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_JP2 = b"\x00\x00\x00\x0cjP  \r\n\x87\n"
_J2K = b"\xff\x4f\xff\x51"
_KNOWN = "GeoTIFF, JPEG 2000, ISIS cube, PDS3, PDS4 (.xml label), VICAR"


def driver_of(path: Path) -> str:
    """Name of the GDAL driver for a map.

    Raises
    ------
    InputError
        When the file cannot be read, is of another format, or is a label that points to
        files outside its folder.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        problem = f"cannot be read as a map: {error.strerror}"
        raise InputError(problem, source=path, remedy="check the path") from error
    if head.startswith(_TIFF):
        return "GTiff"
    if head.startswith((_JP2, _J2K)):
        return "JP2OpenJPEG"
    if re.search(rb"Object\s*=\s*IsisCube", head):
        _check_pointers(path, rb"\^\w+\s*=\s*\"?([^\"\r\n]+)")
        return "ISIS3"
    if b"PDS_VERSION_ID" in head or b"ODL_VERSION_ID" in head:
        _check_pointers(path, rb"\^\w+\s*=\s*\(?\s*\"([^\"]+)\"")
        return "PDS"
    if b"LBLSIZE=" in head[:20]:
        return "VICAR"
    if b"Product_Observational" in head or b"http://pds.nasa.gov/pds4" in head:
        _check_pointers(path, rb"<file_name>\s*([^<]+?)\s*</file_name>")
        return "PDS4"
    raise InputError(
        "cannot be read as a map: it is of no known format",
        source=path,
        remedy=f"known: {_KNOWN}; bring others over with gdal_translate -of COG",
    )


def _check_pointers(path: Path, pattern: bytes) -> None:
    """Refuse labels that name anything but files beside themselves."""
    with path.open("rb") as file:
        label = file.read(256_000)
    for name in re.findall(pattern, label):
        text = name.decode("latin-1").strip()
        if "/" in text or "\\" in text or text in ("..", "."):
            raise InputError(
                f"its label points to {text[:100]!a}, outside of its folder",
                source=path,
                field="label",
                remedy="labels from untrusted places may name anything: it is not opened",
            )
