"""``surrogym sample --on-ray``: what is refused before a sampler starts."""

from __future__ import annotations

import uuid

import pytest

from support.moody import SPEC
from surrogym_client.transport import Api


@pytest.fixture
def line(server_process):
    name = f"line-{uuid.uuid4().hex[:8]}"
    with Api(server_process.url) as api:
        api.create_surrogate(name, SPEC)
        yield name
        api.delete_surrogate(name)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--on-ray", "2", "--once"), "--on-ray: expected --until-done or --time-limit, got --once"),
        (("--runtime-env", "env.yaml"), "--runtime-env: expected --on-ray N"),
        (("--on-ray", "2", "--ray-resources", "CPU=-1"), "--ray-resources: expected NAME=AMOUNT"),
        (("--on-ray", "2", "--ray-resources", "robot"), "--ray-resources: expected NAME=AMOUNT"),
        (
            ("--on-ray", "2", "--ray-address", "127.0.0.1:9"),
            "error: --on-ray: expected a Ray cluster at '127.0.0.1:9', got none (Connection refused); start one with "
            "RAY_worker_niceness=0 ray start --head",
        ),
        (("--on-ray", "2", "--runtime-env", "env.yaml"), "--runtime-env: expected names with values in env.yaml"),
    ],
)
def test_sampling_on_ray_refuses_incompatible_options_in_one_sentence(options, words, on_server, line, tmp_path):
    (tmp_path / "env.yaml").write_text("- nothing\n")
    said = on_server("sample", line, "--env", "support.moody:Line", *options)
    assert (said.code, said.out) == (1, "")
    assert words in " ".join(said.err.split())
    assert "Traceback" not in said.err


def test_sampling_on_ray_without_ray_tells_how_to_install_it(on_server, line, monkeypatch):
    monkeypatch.setattr("surrogym_client.runtime.ray_cluster.find_spec", lambda _: None)
    said = on_server("sample", line, "--env", "support.moody:Line", "--on-ray", "2")
    assert (said.code, said.out) == (1, "")
    assert said.err == "error: --on-ray: expected the package ray, got none: pip install 'surrogym[ray]'\n"
