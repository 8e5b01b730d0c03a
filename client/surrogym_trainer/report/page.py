"""The page of the report: embedded pictures, tables, and a content security policy by which it loads nothing. The
report is a file in HTML, or in PDF if Chromium is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from surrogym_client.errors import SurrogymClientError
from surrogym_client.runtime.versions import versions
from surrogym_client.surrogates.waiting import IN_WORDS
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import ModelView, Phase, SampleView, SurrogateView
from surrogym_trainer.coverage import Cut, coverage_of
from surrogym_trainer.figures import draw_coverage, draw_fidelity, draw_maps, draw_samples, svg
from surrogym_trainer.policies.controller_check import StoredCheck
from surrogym_trainer.report.decision import decision
from surrogym_trainer.report.html import document, picture, rows, section, table
from surrogym_trainer.report.known import Known

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SECONDS = 120.0


class NoPdf(SurrogymClientError):
    """No PDF could be made."""


def write(out: Path, page: str) -> int:
    """Write an HTML page to the file ``out``, as HTML or PDF by the file's ending, and return the file's size in bytes.

    Raises:
        NoPdf: Chromium is not installed, or it failed; nothing was written.
    """
    content = as_pdf(page) if out.suffix.lower() == ".pdf" else page.encode()
    return out.write_bytes(content)


def as_pdf(page: str) -> bytes:
    """Return a page as PDF, printed by a headless Chromium. Raises ``NoPdf`` if Chromium is not installed or fails."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise NoPdf("a PDF needs Chromium, which is not installed: install it, or write HTML with --out report.html")
    with TemporaryDirectory() as folder:
        html, pdf = Path(folder) / "report.html", Path(folder) / "report.pdf"
        html.write_text(page, encoding="utf-8")
        options = (
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/own",
        )
        command = [browser, *options, f"--print-to-pdf={pdf}", html.as_uri()]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=SECONDS)
            return pdf.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            raise NoPdf(f"no PDF was made: {browser} failed: {error}; print the HTML from a browser") from error


FIDELITY = {
    "output": "name",
    "confidence index": "confidence_index",
    "as in the paper": "confidence_index_paper",
    "tolerance": "tolerance",
    "coverage": "coverage",
    "leave-one-out error": "leave_one_out_error",
    "within 1 std": "leave_one_out_within_one",
    "within 2": "leave_one_out_within_two",
    "noise": "noise",
}
LEDGER = ("initial", "adaptive", "manual", "total", "audit", "logged", "evaluation", "unresolved", "resets", "wear")

PHASES: dict[Phase, str] = {
    **IN_WORDS,
    "collecting": "the first real steps are being taken",
    "fitting": "the model is learning from new real steps",
    "sampling": "further real steps are being taken where the model is unsure",
}


def page(known: Known, cuts: Sequence[Cut] = ()) -> str:
    """Return the page of a surrogate as HTML in one file: first the part for decisions, then the details.

    Args:
        known: what the server knows about the surrogate and about one of its policies.
        cuts: the latest model's maps over two coordinates.
    """
    view, now = known.view, datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    about = f"{view.environment or 'own environment'}, at {known.server}, {now}"
    details = "".join(_details(known, cuts))
    return document(
        f"Report on {view.name}",
        f'<h1>{escape(view.name)}</h1><p class="about">{escape(about)}</p>{decision(known, cuts)}'
        f'<h1 class="part">Details</h1>{details}<footer><p>Written with {escape(packages)}.</p></footer>',
    )


def _details(known: Known, cuts: Sequence[Cut]) -> list[str]:
    view, models, samples = known.view, known.models, known.samples
    sections = [_summary(known), _spent(view)]
    if models:
        sections.append(_fidelity(view, models))
    if samples:
        figure = picture(svg(draw_samples(view, samples)), "Where the real steps began, two coordinates a picture")
        sections.append(section("Samples", figure + _covered(view, samples)))
    if cuts:
        sections.append(_maps(view, cuts))
    if known.check is not None:
        sections.append(_on_controller(known.check))
    if models:
        sections += [_structure(models[-1], view.spec), _history(models)]
    specification = escape(view.spec.model_dump_json(indent=2))
    sections.append(section("Specification", f"<details><summary>JSON</summary><pre>{specification}</pre></details>"))
    return sections


def _covered(view: SurrogateView, samples: Sequence[SampleView]) -> str:
    """Return the coverage of the log as HTML; empty if there are no logged steps."""
    logged = [sample for sample in samples if sample.purpose == "logged"]
    if not logged:
        return ""
    q, u = np.array([sample.coordinates for sample in logged]), np.array([sample.action for sample in logged])
    coverage = coverage_of(view.spec, q, u)
    shown = picture(svg(draw_coverage(coverage)), "How often the log was in each cell of two columns")
    return f"{shown}<p>{escape(coverage.words())}</p>"


def _summary(known: Known) -> str:
    view = known.view
    index = "no model yet" if view.confidence_index is None else f"{view.confidence_index:.4f}"
    facts = [
        ("phase", f"{PHASES[view.phase]}, paused" if view.paused else PHASES[view.phase]),
        ("confidence index", f"{index}, target {view.target:g}"),
        ("real steps", f"{view.ledger.total} taken, {view.budget} allowed"),
        ("model", view.model_version),
        ("queries", ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in view.queries)),
        *([("last error", view.error)] if view.error else []),
        *(("limits", words) for words in known.limits),
    ]
    return section("State of the design", rows(facts))


def _spent(view: SurrogateView) -> str:
    counted = table(LEDGER, [[getattr(view.ledger, name) for name in LEDGER]], "Real steps by purpose")
    return section("Ledger", counted)


def _fidelity(view: SurrogateView, models: Sequence[ModelView]) -> str:
    outputs = models[-1].fidelity.outputs
    judged = table(
        tuple(FIDELITY), [[getattr(o, field) for field in FIDELITY.values()] for o in outputs], "The latest model"
    )
    alt = "Confidence index and leave-one-out error of every output against the number of real samples"
    return section("Fidelity", picture(svg(draw_fidelity(models, view.target)), alt) + judged)


def _maps(view: SurrogateView, cuts: Sequence[Cut]) -> str:
    alt = "Uncertainty in tolerances, occupancy, and the index, over two coordinates a row"
    note = "<p>The worst output; the other coordinates and the action are in the middle of their ranges.</p>"
    return section("Maps", picture(svg(draw_maps(view, cuts)), alt) + note)


def _on_controller(check: StoredCheck) -> str:
    latency = (
        "not measured" if check.microseconds is None else f"{check.microseconds:.2g} µs on the machine of the check"
    )
    facts = [
        ("controller", f"target {check.target}, made from the policy's file {check.policy[:12]}"),
        ("checked in", f"{check.environment}, {check.episodes} episodes of the controller and as many of the policy"),
        ("mean return", f"{check.mean_return:.6g}, of the policy {check.mean_return_of_policy:.6g}"),
        ("largest difference of actions", f"{check.largest_difference:.1g} of their range"),
        ("steps with another action", f"{check.different_actions} of {check.steps}"),
        ("steps with the fallback", check.faults),
        ("a decision takes", latency),
    ]
    note = (
        "<p>The check ran the controller and the policy in the same environment from the same starts. "
        "A difference of actions is rounding, if it is small beside the range.</p>"
    )
    return section("On the controller", note + rows(facts))


def _structure(model: ModelView, spec: EnvironmentSpec) -> str:
    angles = any(coordinate.kind == "angle" for coordinate in spec.coordinates)
    described = dict(model.description if angles else _without_angles(model.description))
    parts = [
        f"<h3>{escape(str(output.get('name')))}</h3>{rows((k, v) for k, v in output.items() if k != 'name')}"
        for output in described.pop("outputs", [])
    ]
    details = "".join(parts) + rows(described.items())
    return section(f"Structure and hyperparameters of model {model.version}", details)


def _without_angles(described: Any) -> Any:
    """Return a model's description in which the input map ``cos_sin`` is called ``coordinates``, for an environment
    without angles."""
    if isinstance(described, str):
        return described.replace("cos_sin", "coordinates")
    if isinstance(described, dict):
        return {_without_angles(key): _without_angles(value) for key, value in described.items()}
    return [_without_angles(one) for one in described] if isinstance(described, list) else described


def _history(models: Sequence[ModelView]) -> str:
    heading = ("version", "samples", "confidence index", "seconds", "fitted", "hash of its data")
    fits = [
        (
            *(m.version, m.samples, m.fidelity.confidence_index, m.fit_seconds),
            *(datetime.fromtimestamp(m.created_at, UTC).strftime("%Y-%m-%d %H:%M:%S"), m.data_hash[:12]),
        )
        for m in models
    ]
    return section("Models", table(heading, fits, "Every fit, oldest first"))
