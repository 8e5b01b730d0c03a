"""What a file of a policy looks like from outside. Nothing is loaded: neither arrays nor objects, let alone code."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable

from surrogym_server.errors import InvalidInput
from surrogym_shared import network

MOST_ENTRIES = 10_000  # of a zip
ENTRY = b"PK\x01\x02"  # begins each of them in its directory
STABLE_BASELINES = {"data", "policy.pth"}  # entries of what Stable-Baselines3 saves


def check_file(form: str, content: bytes, size: int, digest: str) -> None:
    """Check a file against its announcement and its form.

    Raises:
        InvalidInput: another size or digest, or it does not look like a file of this form.
    """
    if len(content) != size:
        raise InvalidInput(f"expected a file of {size} bytes, as announced, got {len(content)}")
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise InvalidInput(f"expected a file with SHA-256 {digest}, as announced, got {found}")
    expected, looks_right = FORMS[form]
    if not looks_right(content):
        raise InvalidInput(f"expected {expected}, got content that begins with {content[:8]!r}")


def _names(content: bytes) -> set[str]:
    """Names of a zip's entries; none where it is no zip, or has too many. Those are counted before they are read: each
    takes a server ten times the memory that it takes in the file."""
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
    "onnx": ("a model in ONNX", lambda content: content[:1] == b"\x08"),  # the version of its format comes first
    "pt2": ("a program of torch.export", lambda content: bool(_names(content))),
    "mp4": ("an MP4 video", lambda content: content[4:8] == b"ftyp"),
    "gif": ("a GIF", lambda content: content[:6] in (b"GIF87a", b"GIF89a")),
}
