"""HTML of the report, which loads nothing: pictures are embedded, the style sheet is allowed by its hash, and there is
no script."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

STYLE = """
:root { color-scheme: light dark; --line: light-dark(#d6d6d6, #444); --soft: light-dark(#666, #aaa); }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2.5rem; } h1.part { margin-top: 4rem; border-top: 3px solid var(--line); }
p.short { font-size: 1.2em; border-left: 5px solid; padding-left: 1rem; }
p.about, caption, footer { color: var(--soft); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0; }
caption { text-align: left; }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 1rem 0.25rem 0; border-bottom: 1px solid var(--line); }
img, video { width: 100%; max-width: 45rem; background: white; border-radius: 0.5rem; display: block; margin: 1rem 0; }
pre { overflow-x: auto; font-size: 0.85em; }
@media print {
  body { max-width: none; margin: 0; color: black; } section { break-inside: avoid; } h1.part { break-before: page; }
  img { max-width: 100%; } .moving { display: none; }
}
"""


def document(title: str, body: str) -> str:
    """Return a page that loads nothing: pictures are embedded, the style sheet is allowed by its hash, and there is no
    script."""
    digest = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; media-src data:; style-src 'sha256-{digest}'"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )


def paragraph(text: str, kind: str = "") -> str:
    """Return plain text as a paragraph in HTML, with a class ``kind`` of the style sheet."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def bullets(items: Iterable[str]) -> str:
    """Return plain texts as a list in HTML."""
    return f"<ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"


def section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def picture(image: str, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/svg+xml;base64,{base64.b64encode(image.encode()).decode()}">'


def moving(kind: str, content: bytes, alt: str) -> str:
    """Return HTML that embeds a video or an animated picture in the page; ``kind`` is its media type."""
    source = f"data:{kind};base64,{base64.b64encode(content).decode()}"
    if kind.startswith("image/"):
        return f'<img alt="{escape(alt)}" src="{source}">'
    return f'<video controls muted aria-label="{escape(alt)}" src="{source}">This browser plays no {kind}.</video>'


def on_screen(content: str) -> str:
    """Return HTML content that is hidden when the page is printed."""
    return f'<div class="moving">{content}</div>'


def rows(pairs: Iterable[tuple[str, Any]]) -> str:
    cells = (
        f'<tr><th scope="row">{escape(name.replace("_", " "))}</th><td>{cell(value)}</td></tr>' for name, value in pairs
    )
    return f'<div class="wide"><table>{"".join(cells)}</table></div>'


def table(heading: Sequence[str], rows: Iterable[Sequence[Any]], caption: str) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in heading)
    body = "".join(f"<tr>{''.join(f'<td>{cell(value)}</td>' for value in row)}</tr>" for row in rows)
    return (
        f'<div class="wide"><table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def cell(value: Any) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.4g}"
        case dict() if value:
            return rows(value.items())
        case list() if all(isinstance(v, int | float) for v in value):
            return escape(", ".join(cell(v) for v in value) or "-")
        case dict() | list():
            return escape(json.dumps(value) if value else "-")
        case _:
            return escape(str(value))
