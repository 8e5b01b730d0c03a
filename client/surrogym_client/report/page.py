"""The page: figures as pictures inside it, tables, and a policy that lets it load nothing."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

from surrogym_client.report.figures import draw_fidelity, draw_maps, draw_samples, svg
from surrogym_client.report.maps import Cut
from surrogym_client.runtime.versions import versions
from surrogym_shared.wire import ModelView, SampleView, SurrogateView

STYLE = """
:root { color-scheme: light dark; --line: light-dark(#d6d6d6, #444); --soft: light-dark(#666, #aaa); }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2.5rem; }
p.about, caption, footer { color: var(--soft); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0; }
caption { text-align: left; }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 1rem 0.25rem 0; border-bottom: 1px solid var(--line); }
img { width: 100%; max-width: 45rem; background: white; border-radius: 0.5rem; display: block; margin: 1rem 0; }
pre { overflow-x: auto; font-size: 0.85em; }
"""
FIDELITY = {
    "output": "name",
    "confidence index": "confidence_index",
    "as in the paper": "confidence_index_paper",
    "tolerance": "tolerance",
    "coverage": "coverage",
    "leave-one-out error": "leave_one_out_error",
    "within 1 deviation": "leave_one_out_within_one",
    "within 2": "leave_one_out_within_two",
    "noise": "noise",
}
LEDGER = ("initial", "adaptive", "manual", "total", "audit", "logged", "evaluation", "unresolved")


def page(
    view: SurrogateView,
    models: Sequence[ModelView],
    samples: Sequence[SampleView],
    server: str,
    cuts: Sequence[Cut] = (),
) -> str:
    """The whole page of a surrogate, HTML in one file.

    Args:
        view: the surrogate.
        models: all of them, oldest first; there may be none yet.
        samples: all of them.
        server: where it is, and of which version.
        cuts: what the latest model says over two coordinates.
    """
    sections = [_summary(view), _spent(view)]
    if models:
        sections += [_fidelity(view, models), _structure(models[-1]), _history(models)]
    if samples:
        figure = _picture(svg(draw_samples(view, samples)), "Where the real steps began, two coordinates a picture")
        sections.insert(-2 if models else len(sections), _section("Samples", figure))
    if cuts:
        sections.insert(-2, _maps(view, cuts))
    specification = escape(view.spec.model_dump_json(indent=2))
    sections.append(_section("Specification", f"<details><summary>JSON</summary><pre>{specification}</pre></details>"))
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    return _document(
        f"Surrogate {view.name}",
        f'<h1>{escape(view.name)}</h1><p class="about">{escape(view.environment or "own environment")}, at '
        f"{escape(server)}, {now}</p>{''.join(sections)}<footer><p>Written with {escape(packages)}.</p></footer>",
    )


def _document(title: str, body: str) -> str:
    """HTML that loads nothing: pictures are inside, the one style sheet is known by its hash, there is no script."""
    digest = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )


def _summary(view: SurrogateView) -> str:
    index = "no model yet" if view.confidence_index is None else f"{view.confidence_index:.4f}"
    rows = [
        ("phase", f"{view.phase}, paused" if view.paused else view.phase),
        ("confidence index", f"{index}, target {view.target:g}"),
        ("real steps", f"{view.ledger.total} of {view.budget}"),
        ("model", view.model_version),
        ("queries", ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in view.queries)),
        *([("last error", view.error)] if view.error else []),
    ]
    return _rows(rows)


def _spent(view: SurrogateView) -> str:
    table = _table(LEDGER, [[getattr(view.ledger, name) for name in LEDGER]], "Real steps by purpose")
    return _section("Ledger", table)


def _fidelity(view: SurrogateView, models: Sequence[ModelView]) -> str:
    outputs = models[-1].fidelity.outputs
    table = _table(
        tuple(FIDELITY), [[getattr(o, field) for field in FIDELITY.values()] for o in outputs], "The latest model"
    )
    alt = "Confidence index and leave-one-out error of every output against the number of real samples"
    return _section("Fidelity", _picture(svg(draw_fidelity(models, view.target)), alt) + table)


def _maps(view: SurrogateView, cuts: Sequence[Cut]) -> str:
    alt = "Uncertainty in tolerances, occupancy, and the index, over two coordinates a row"
    note = "<p>The worst output; the other coordinates and the action are in the middle of their ranges.</p>"
    return _section("Maps", _picture(svg(draw_maps(view, cuts)), alt) + note)


def _structure(model: ModelView) -> str:
    described = dict(model.description)
    parts = [
        f"<h3>{escape(str(output.get('name')))}</h3>{_rows((k, v) for k, v in output.items() if k != 'name')}"
        for output in described.pop("outputs", [])
    ]
    return _section(
        f"Structure and hyperparameters of model {model.version}", "".join(parts) + _rows(described.items())
    )


def _history(models: Sequence[ModelView]) -> str:
    heading = ("version", "samples", "confidence index", "seconds", "fitted", "hash of its data")
    rows = [
        (
            *(m.version, m.samples, m.fidelity.confidence_index, m.fit_seconds),
            *(datetime.fromtimestamp(m.created_at, UTC).strftime("%Y-%m-%d %H:%M:%S"), m.data_hash[:12]),
        )
        for m in models
    ]
    return _section("Models", _table(heading, rows, "Every fit, oldest first"))


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _picture(image: str, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/svg+xml;base64,{base64.b64encode(image.encode()).decode()}">'


def _rows(rows: Iterable[tuple[str, Any]]) -> str:
    cells = (
        f'<tr><th scope="row">{escape(name.replace("_", " "))}</th><td>{_cell(value)}</td></tr>' for name, value in rows
    )
    return f'<div class="wide"><table>{"".join(cells)}</table></div>'


def _table(heading: Sequence[str], rows: Iterable[Sequence[Any]], caption: str) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in heading)
    body = "".join(f"<tr>{''.join(f'<td>{_cell(value)}</td>' for value in row)}</tr>" for row in rows)
    return (
        f'<div class="wide"><table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(value: Any) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.4g}"
        case dict() if value:
            return _rows(value.items())
        case list() if all(isinstance(v, int | float) for v in value):
            return escape(", ".join(_cell(v) for v in value) or "-")
        case dict() | list():
            return escape(json.dumps(value) if value else "-")
        case _:
            return escape(str(value))
