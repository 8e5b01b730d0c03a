"""Checks of a policy's file from outside. Nothing in it is loaded, neither arrays nor objects nor code."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable

from surrogym_server.errors import InvalidInput
from surrogym_shared import network

MOST_ENTRIES = 10_000  # of a zip
ENTRY = b"PK\x01\x02"  # first bytes of each entry in the zip's directory
STABLE_BASELINES = {"data", "policy.pth"}  # entries of a file of Stable-Baselines3


def check_file(form: str, content: bytes, size: int, digest: str) -> None:
    """Check a file against its announcement and its form.

    Raises:
        InvalidInput: the size or digest differs, or the content does not have this form.
    """
    if len(content) != size:
        raise InvalidInput(f"expected a file of {size} bytes, as announced, got {len(content)}: send the whole file")
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise InvalidInput(f"expected a file with SHA-256 {digest}, as announced, got {found}: send the file again")
    expected, looks_right = FORMS[form]
    if not looks_right(content):
        raise InvalidInput(f"expected {expected}, got content that begins with {content[:8]!r}")


def _names(content: bytes) -> set[str]:
    """Names of a zip's entries; none if it is not a zip, or has too many entries. They are counted before they are
    read, because each takes ten times the memory that it takes in the file."""
    if content.count(ENTRY) > MOST_ENTRIES:
        return set()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return set()
    return set(names)


def _is_policy(content: bytes) -> bool:
    names = _names(content)
    return network.HEAD in names or names >= STABLE_BASELINES


FORMS: dict[str, tuple[str, Callable[[bytes], bool]]] = {
    "zip": (f"a zip of Stable-Baselines3, or of a network of arrays ({network.HEAD})", _is_policy),
    "onnx": ("a model in ONNX", lambda content: content[:1] == b"\x08"),  # it begins with the version of its format
    "pt2": ("a program of torch.export", lambda content: bool(_names(content))),
    "mp4": ("an MP4 video", lambda content: content[4:8] == b"ftyp"),
    "gif": ("a GIF", lambda content: content[:6] in (b"GIF87a", b"GIF89a")),
}
