"""The dashboard: static files that call the API with a token, which is kept in the browser tab only.

There is no build step: browsers receive these files unchanged. ``uplot`` is a copy of uPlot 1.6.32 with its licence.
"""

from __future__ import annotations

from importlib.resources import files

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob:; "
        "media-src blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
}
TYPES = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}


def _parts() -> dict[str, tuple[str, str]]:
    names = [
        f"{folder}{entry.name}" for folder in ("", "uplot/") for entry in files(__name__).joinpath(folder).iterdir()
    ]
    return {
        f"/page/{name}": (name, TYPES[kind]) for name in sorted(names) if (kind := name.rpartition(".")[2]) in TYPES
    }


FILES = {"/": ("index.html", "text/html"), **_parts()}


def read(name: str) -> bytes:
    """Return the content of a file of the dashboard; ``name`` is a file name of ``FILES``."""
    return files(__name__).joinpath(name).read_bytes()
