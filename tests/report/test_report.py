"""The report is one page that says everything and loads nothing."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_trainer.coverage import Cut, cuts
from surrogym_trainer.figures import draw_fidelity, svg
from surrogym_trainer.report.known import Known
from surrogym_trainer.report.page import page

SVG = "data:image/svg+xml;base64,"
Both = tuple[Known, list[Cut]]


class Page(HTMLParser):
    """Tags with their attributes, and text, of a page that has to be well formed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def known(pendulum_server: ServerProcess) -> Both:
    with Api(pendulum_server.url) as api:
        view = api.surrogate("pendulum")
        models, samples = api.models("pendulum"), list(api.samples("pendulum"))
        shown = cuts(view, partial(api.query_uncertainty, "pendulum"))
    return Known(view, models, samples, "http://here, surrogym 0.1.0"), shown


@pytest.fixture(scope="module")
def text(known: Both) -> str:
    """The page; its pictures take a second."""
    return page(*known)


def test_the_report_contains_ledger_fidelity_samples_and_model_sections(known: Both, text: str) -> None:
    view, models = known[0].view, known[0].models
    read = Page(text)
    titles = [
        "Ledger",
        "Fidelity",
        "Samples",
        "Maps",
        "Structure and hyperparameters of model 1",
        "Models",
        "Specification",
    ]
    assert [text for text in read.texts if text in titles] == titles
    for output in models[-1].fidelity.outputs:
        assert read.texts.count(output.name) >= 2
        assert f"{output.leave_one_out_error:.4g}" in read.texts
    assert "lengthscale" in read.texts
    assert models[0].data_hash[:12] in read.texts
    assert f"{view.ledger.total} taken, {view.budget} allowed" in read.texts
    assert not {"over_budget", "from_log"} & set(re.findall(r"\w+", " ".join(read.texts)))


def test_the_report_explains_angle_encoding_only_if_there_are_angles(known: Both, text: str) -> None:
    about, shown = known
    straight = tuple(one.model_copy(update={"kind": "linear"}) for one in about.view.spec.coordinates)
    view = about.view.model_copy(update={"spec": about.view.spec.model_copy(update={"coordinates": straight})})
    encoding = re.compile("cos[_ ]sin")
    assert encoding.search(text)
    assert not encoding.search(page(replace(about, view=view), shown))


def test_the_report_loads_nothing_and_its_content_security_policy_forbids_it(text: str) -> None:
    read = Page(text)
    assert {tag for tag, _ in read.tags} & {"script", "link", "iframe", "object", "a"} == set()
    for _, attributes in read.tags:
        assert not {"style", "href"} & attributes.keys()
        assert attributes.get("src", SVG).startswith(SVG)
    (style,) = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    assert "url(" not in style
    policy = next(meta["content"] for meta in read.of("meta") if "http-equiv" in meta)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert policy == f"default-src 'none'; img-src data:; media-src data:; style-src 'sha256-{digest}'"


def test_figures_of_the_report_have_alternative_texts(text: str) -> None:
    images = Page(text).of("img")
    assert len(images) == 3
    for image in images:
        assert image["alt"]
        drawn = base64.b64decode(image["src"].removeprefix(SVG)).decode()
        assert ElementTree.fromstring(drawn).tag == "{http://www.w3.org/2000/svg}svg"
        assert re.findall(r"(?:href|src)=\"(?!#|data:image/png;)", drawn) == []


def test_drawing_a_report_figure_twice_gives_the_same_svg(known: Both) -> None:
    assert svg(draw_fidelity(known[0].models, 0.999)) == svg(draw_fidelity(known[0].models, 0.999))


def test_a_map_in_the_report_equals_the_servers_predictions(known: Both, pendulum_server: ServerProcess) -> None:
    (cut,) = known[-1]
    tolerances = np.array([output.tolerance for output in known[0].models[-1].fidelity.outputs])
    with Api(pendulum_server.url) as api:
        corner = api.query_uncertainty("pendulum", [[np.pi, -8.0]], [[0.0]])
    assert (cut.across, cut.up) == (0, 1)
    assert cut.uncertainty[0, -1] == pytest.approx((np.array(corner.deviation[0]) / tolerances).max())
    assert cut.log_index[0, -1] == pytest.approx(max(corner.log_uncertainty_index[0]))


def test_the_report_escapes_html_in_names_errors_and_descriptions(known: Both) -> None:
    hostile = "</td><script>alert(1)</script>"
    model = known[0].models[0].model_copy(update={"description": {"outputs": [{"name": hostile, hostile: [hostile]}]}})
    view = known[0].view.model_copy(update={"error": hostile, "environment": hostile})
    text = page(replace(known[0], view=view, models=[model], server=hostile, missing=(hostile,)))
    assert "<script" not in text
    assert hostile in Page(text).texts


def test_the_report_of_a_surrogate_without_samples_or_models_can_be_made(known: Both) -> None:
    view = known[0].view.model_copy(update={"confidence_index": None, "model_version": None, "fidelity": None})
    read = Page(page(Known(view, [], [], "here")))
    assert "no model yet, target 0.999" in read.texts
    assert read.of("img") == []


def test_the_report_command_writes_the_report(pendulum_server: ServerProcess, tmp_path, monkeypatch, capsys) -> None:
    from surrogym.cli import main

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["report", "pendulum", "--server", pendulum_server.url])
    assert not ended.value.code
    # Tests of this server may have registered policies.
    assert re.search(r"bytes written to report.html, about (no policy yet|pendulum@\d+)\n", capsys.readouterr().out)
    assert (tmp_path / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
