"""Files of somebody else: what they hold is neither run nor obeyed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.gifts import gift
from support.scripted_server import problem, scripted_server
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.codes import Code
from surrogym_shared.network import Network

EVALUATE = ("evaluate", "policy.zip", "--env", "Pendulum-v1", "--episodes", "1")
EXPORT = ("export-policy", "policy.zip", "--out", "policy.onnx")


SECRET = "a-token-of-mine"


def network(folder: Path, **card: Any) -> None:
    """A policy that needs no trust, and its card."""
    d = len(pendulum().observation)
    Network.of(pendulum(), np.zeros(d), np.ones(d), 2, np.zeros(Network.size(pendulum(), 2))).save(
        folder / "policy.zip"
    )
    (folder / "policy.json").write_text(json.dumps(card))


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "the gift has run"


@pytest.mark.parametrize("arguments", [EVALUATE, EXPORT])
def test_a_pickled_policy_file_is_refused_in_one_sentence(surrogym, tmp_path, mark, arguments):
    gift(tmp_path / "policy.zip", mark)
    ended = surrogym(*arguments)
    assert not mark.exists()
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.startswith(
        "error: policy.zip holds pickled objects (policy_class), and reading them would run any"
    )
    assert "give --trust-policy" in ended.err
    assert ended.err.count("\n") == 1


@pytest.mark.parametrize("arguments", [EVALUATE, EXPORT])
def test_a_pickled_policy_file_is_read_with_trust_policy(surrogym, tmp_path, mark, arguments):
    gift(tmp_path / "policy.zip", mark)
    assert surrogym(*arguments, "--trust-policy").code == 1  # it is no policy after all
    assert mark.exists()


@pytest.mark.parametrize("arguments", [EVALUATE, EXPORT])
def test_the_removed_option_trust_is_refused_and_reads_no_pickled_policy(surrogym, tmp_path, mark, arguments):
    gift(tmp_path / "policy.zip", mark)
    ended = surrogym(*arguments, "--trust")
    assert ended.code == 2
    assert not mark.exists()
    assert "'--trust' was removed: use --trust-policy" in ended.err


@pytest.mark.parametrize("options", [(), ("--json",), ("--quiet",)])
def test_a_server_named_only_in_a_policy_file_is_not_contacted(surrogym, tmp_path, monkeypatch, options):
    monkeypatch.setenv("SURROGYM_TOKEN", SECRET)
    with scripted_server(problem(Code.FORBIDDEN)) as server:
        network(tmp_path, surrogate="pendulum", server=server.url)
        ended = surrogym(*EVALUATE, *options)
        assert server.received == []
    assert ended.code == 0, ended.err
    told = f"the real steps are not reported to '{server.url}', which policy.json names: give --server to enter them"
    assert (told in ended.err) == (options != ("--quiet",))
    assert not options or "--json" not in options or ended.json["steps"] == 200


def test_a_server_given_by_option_server_receives_the_real_steps_and_the_token(surrogym, tmp_path, monkeypatch):
    monkeypatch.setenv("SURROGYM_TOKEN", SECRET)
    with scripted_server(problem(Code.FORBIDDEN)) as noted, scripted_server(problem(Code.FORBIDDEN)) as given:
        network(tmp_path, surrogate="pendulum", server=noted.url)
        ended = surrogym(*EVALUATE, "--server", given.url)
        assert noted.received == []
    assert given.received[0].path == "/v1/surrogates/pendulum/ledger"
    assert {request.headers["Authorization"] for request in given.received} == {f"Bearer {SECRET}"}
    assert "not entered into the ledger of 'pendulum'" in ended.err


@pytest.mark.parametrize("name", ["..", "a/b", "", "a b", "pendulum/../other", "pendulum\n"])
def test_a_policy_description_with_an_invalid_surrogate_name_is_refused(surrogym, tmp_path, name):
    network(tmp_path, surrogate=name)
    ended = surrogym(*EVALUATE)
    assert ended.code == 1
    assert ended.err.startswith("error: policy.json is not the card of a policy: surrogate: ")


@pytest.mark.parametrize(
    ("limit", "steps", "said"),
    [
        (20_000, 200, "the policy's card has a time limit of 20000 steps, that of Pendulum-v1 is 200"),
        (None, 200, "the policy's card has a time limit of none, that of Pendulum-v1 is 200"),
        (50, 50, ""),
    ],
)
def test_a_policy_description_can_only_shorten_the_environments_time_limit(surrogym, tmp_path, limit, steps, said):
    """A limit of the card's own would let a gift take as many real steps as it wants."""
    spec = pendulum().model_copy(update={"time_limit": limit})
    network(tmp_path, spec=spec.model_dump(mode="json"))
    ended = surrogym(*EVALUATE, "--json")
    assert ended.code == 0, ended.err
    assert ended.json["steps"] == steps
    assert said in ended.err
    assert bool(said) == ("time limit" in ended.err)


def test_a_specification_given_by_option_spec_can_lengthen_the_time_limit(surrogym, tmp_path):
    longer = pendulum().model_copy(update={"time_limit": 300})
    network(tmp_path)
    (tmp_path / "spec.json").write_text(longer.model_dump_json())
    ended = surrogym(*EVALUATE, "--spec", "spec.json", "--json")
    assert ended.json["steps"] == 300
