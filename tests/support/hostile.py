"""What a hostile or broken client sends: mutated bodies, requests that never end, and a look at what it cost."""

from __future__ import annotations

import random
import re
import socket
from pathlib import Path
from urllib.parse import urlsplit

TOKENS = [b"NaN", b"1e999", b"-1e999", b"5e-324", b"null", b'""', b"[]", b"{}", b"true", b"9" * 400, b"[" * 2_000]
KEY = "c3Vycm9neW0tZnJhbWVzLg=="  # of a handshake: any 16 bytes
NUMBER = re.compile(rb"-?\d+(\.\d+)?")


def mutated(source: random.Random, content: bytes) -> bytes:
    """The content with one to four mistakes in it."""
    for _ in range(source.randint(1, 4)):
        content = source.choice([_flipped, _without, _doubled, _stuffed, _renumbered])(source, content)
    return content


def _slice(source: random.Random, content: bytes) -> tuple[int, int]:
    start = source.randint(0, len(content))
    return start, min(len(content), start + source.randint(0, 16))


def _flipped(source: random.Random, content: bytes) -> bytes:
    if not content:
        return content
    at = source.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << source.randrange(8)]) + content[at + 1 :]


def _without(source: random.Random, content: bytes) -> bytes:
    start, end = _slice(source, content)
    return content[:start] + content[end:] if source.random() < 0.8 else content[:start]


def _doubled(source: random.Random, content: bytes) -> bytes:
    start, end = _slice(source, content)
    return content[:end] + content[start:end] * source.randint(1, 100) + content[end:]


def _stuffed(source: random.Random, content: bytes) -> bytes:
    at = source.randint(0, len(content))
    return content[:at] + source.randbytes(source.randint(1, 16)) + content[at:]


def _renumbered(source: random.Random, content: bytes) -> bytes:
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    chosen = source.choice(found)
    return content[: chosen.start()] + source.choice(TOKENS) + content[chosen.end() :]


def resident_mib(pid: int) -> float:
    """Memory of a process that is in use."""
    line = next(x for x in Path(f"/proc/{pid}/status").read_text().splitlines() if x.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def connected(url: str, seconds: float = 60.0) -> socket.socket:
    """A bare connection to the server at a URL."""
    parts = urlsplit(url)
    assert parts.hostname is not None
    return socket.create_connection((parts.hostname, parts.port or 80), seconds)


def head(path: str, *lines: str) -> bytes:
    """The head of a POST of JSON."""
    return "\r\n".join([f"POST {path} HTTP/1.1", "host: 127.0.0.1", "content-type: application/json", *lines]).encode()


def read_all(opened: socket.socket) -> bytes:
    """What comes until the server closes the connection."""
    parts = []
    try:
        while part := opened.recv(65_536):
            parts.append(part)
    except ConnectionResetError:
        pass
    return b"".join(parts)


def upgraded(url: str, session: str) -> socket.socket:
    """The stream of a session, as a bare connection."""
    opened = connected(url)
    lines = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {KEY}")
    head = [f"GET /v1/sessions/{session}/stream HTTP/1.1", "Host: 127.0.0.1", *lines, "", ""]
    opened.sendall("\r\n".join(head).encode())
    assert opened.recv(65_536).startswith(b"HTTP/1.1 101")
    return opened
