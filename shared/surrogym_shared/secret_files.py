"""Files with secrets: read tokens from them, and check who else can read them."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import get_args

from surrogym_shared.wire import Role

MAX_BYTES = 64 * 2**10  # largest size of a file of tokens
OTHERS = stat.S_IRGRP | stat.S_IROTH


def open_to_others(path: Path) -> str | None:
    """Return a warning, with its remedy, if other users of this machine can read a file; else None."""
    try:
        status = path.stat().st_mode
    except OSError:
        return None
    mode = stat.S_IMODE(status)
    if stat.S_ISDIR(status):
        return None  # the path is a folder; reading it as a file raises an error later
    if os.name != "posix" or not mode & OTHERS:
        return None
    return f"{path} may be read by other users of this machine (mode {mode:o}): chmod 600 {path} prevents this"


def tokens_in(path: Path) -> dict[str, Role]:
    """Read a file with one ``role:token`` per line. Return the role of each token.

    Raises:
        OSError: the file can't be read.
        ValueError: the file has no token, an unknown role, or too many bytes; the message contains no token.
    """
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} bytes, got more: is this another file?")
    try:
        text = content.decode()
    except UnicodeDecodeError:
        raise ValueError("expected UTF-8, got other bytes: is this another file?") from None
    lines = [line.strip() for line in text.splitlines()]
    if not any(lines):
        raise ValueError("expected lines of the form role:token, got an empty file: write a line such as sample:TOKEN")
    return dict(parse_token(line) for line in lines if line)


def parse_token(entry: str) -> tuple[str, Role]:
    """Split ``role:token`` into token and role. A token without a role is an admin's.

    Raises:
        ValueError: an unknown role; the message contains no token.
    """
    role, colon, token = entry.partition(":")
    if not colon:
        return entry, "admin"
    for candidate in get_args(Role):
        if role == candidate:
            return token, candidate
    raise ValueError(f"a token's role: expected one of {', '.join(get_args(Role))} before the colon, got another word")
