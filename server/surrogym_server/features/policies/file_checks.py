"""Checks of a policy's file without loading anything from it, neither arrays nor objects nor code."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable

from surrogym_server.errors import InvalidInput
from surrogym_shared import network

MOST_ENTRIES = 10_000  # a zip file with more entries is not accepted as a policy
ENTRY = b"PK\x01\x02"  # first bytes of each entry in the directory of a zip file
STABLE_BASELINES = {"data", "policy.pth"}  # names of entries that a file of Stable-Baselines3 has


def check_file(form: str, content: bytes, size: int, digest: str) -> None:
    """Check the content of a policy's file.

    Args:
        form: format of the file, a key of ``FORMS``.
        content: the file.
        size: size in bytes that the sender announced.
        digest: SHA-256 hash, as hex, that the sender announced.

    Raises:
        InvalidInput: the size or hash differs, or the content does not look like this format.
    """
    if len(content) != size:
        raise InvalidInput(f"expected a file of {size} bytes, as announced, got {len(content)}: send the whole file")
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise InvalidInput(f"expected a file with SHA-256 {digest}, as announced, got {found}: send the file again")
    expected, looks_right = FORMS[form]
    if not looks_right(content):
        raise InvalidInput(f"expected {expected} for the format {form!r}, got content that begins with {content[:8]!r}")


def _names(content: bytes) -> set[str]:
    """Return the names of a zip file's entries; empty if the content is no zip file or has too many entries.

    The entries are counted first, because a parsed entry takes ten times its size in the file.
    """
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
    "onnx": ("a model in ONNX", lambda content: content[:1] == b"\x08"),  # begins with the field of the format version
    "pt2": ("a program of torch.export", lambda content: bool(_names(content))),
    "mp4": ("an MP4 video", lambda content: content[4:8] == b"ftyp"),
    "gif": ("a GIF", lambda content: content[:6] in (b"GIF87a", b"GIF89a")),
}
