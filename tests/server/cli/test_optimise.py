"""``surrogym optimise``: from files to a policy and its card; what can't be optimised is one sentence."""

import json
from pathlib import Path

import pytest

from support.models import learn
from support.real_steps import random_steps
from support.server import ended
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.models.files import to_bytes
from surrogym_shared.network import Network
from surrogym_trainer.policies import read_card


def optimise(folder: Path, *options: str) -> tuple[int, str]:
    return ended(folder, "optimise", "--spec", "spec.json", "--model", "m.safetensors", *options)


def export(folder: Path, spec) -> None:
    model = learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model
    (folder / "spec.json").write_text(spec.model_dump_json())
    (folder / "m.safetensors").write_bytes(to_bytes(model))


def test_a_policy_and_its_card_are_written(tmp_path: Path):
    export(tmp_path, pendulum())
    status, said = optimise(tmp_path, "--updates", "2", "--horizon", "3", "--seed", "4")
    assert status == 0, said
    assert "optimise: 2 of 2 updates" in said
    assert "next: surrogym evaluate policy.zip" in said
    policy = tmp_path / "policy.zip"
    assert Network.is_at(policy)
    card = read_card(policy)
    assert (card.algorithm, card.seed, card.spec) == ("gradient", 4, pendulum())
    assert json.loads((tmp_path / "policy.json").read_text())["settings"]["updates"] == 2


@pytest.mark.parametrize("missing", [True, False], ids=["no file", "discrete"])
def test_an_impossible_optimisation_is_refused_in_one_sentence(tmp_path: Path, missing: bool):
    if not missing:
        export(tmp_path, cartpole())
    status, said = optimise(tmp_path)
    assert status == 1
    error = said.splitlines()[-1]
    assert error.startswith("error: ")
    assert ("spec.json" if missing else "expected continuous actions") in error
    assert not (tmp_path / "policy.zip").exists()
