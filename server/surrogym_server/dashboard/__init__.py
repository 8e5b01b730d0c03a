"""The page people look at: static files that read the API with a token kept in the browser tab alone."""

from __future__ import annotations

from importlib.resources import files

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
FILES = {
    "/": ("index.html", "text/html"),
    "/dashboard.js": ("dashboard.js", "text/javascript"),
    "/dashboard.css": ("dashboard.css", "text/css"),
}


def read(name: str) -> bytes:
    """The content of one of ``FILES``."""
    return files(__name__).joinpath(name).read_bytes()
