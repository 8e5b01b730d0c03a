"""Policies of surrogym train are read without unpickling anything, the same to the bit; others are refused."""

from __future__ import annotations

import io
import json
import pickle
import re
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from support.exact_pendulum import ExactPendulum
from support.gifts import LIMIT, Touches, changed, gift, pickled
from surrogym_client.transport import Api
from surrogym_shared.archives import read_entries, stored
from surrogym_trainer.policies.card import (
    MAX_CARD_BYTES,
    NotedAddress,
    PolicyCard,
    UnusablePolicy,
    read_card,
    write_card,
)
from surrogym_trainer.policies.defaults import decaying
from surrogym_trainer.policies.export import export_policy
from surrogym_trainer.policies.files import load_learner, load_policy, save_policy
from surrogym_trainer.policies.networks import PaperPolicy, Standardise
from surrogym_trainer.policies.structure import ENTRY, MAX_EXPERIENCE_BYTES, Structure, describe
from surrogym_trainer.training import TrainSettings, train

OBSERVED = spaces.Box(-np.inf, np.inf, (3,), np.float32)
TORQUES = spaces.Box(np.array([-2.0, 0.1], np.float32), np.array([2.0, 10.0], np.float32))
STATISTICS = {"mean": [1.0, 0.0, -2.0], "deviation": [2.0, 1.0, 4.0]}
OBSERVATIONS = (3 * np.random.default_rng(1).standard_normal((200, 3))).astype(np.float32)
SMALL = {"buffer_size": 100, "learning_starts": 20}
PPO = {"n_steps": 8, "batch_size": 8, "learning_rate": decaying, "clip_range": 0.3, "clip_range_vf": 0.1}
CASES: dict[str, tuple[str, spaces.Space[Any], dict[str, Any]]] = {
    "PPO, continuous": ("PPO", TORQUES, PPO),
    "PPO, noise by the state": ("PPO", TORQUES, PPO | {"use_sde": True}),
    "PPO, discrete": ("PPO", spaces.Discrete(3), PPO),
    "PPO, several discrete": ("PPO", spaces.MultiDiscrete([2, 3]), PPO | {"learning_rate": 1e-3}),
    "A2C": ("A2C", TORQUES, {"use_sde": True}),
    "SAC": ("SAC", TORQUES, SMALL),
    "SAC, noise by the state": ("SAC", TORQUES, SMALL | {"use_sde": True}),
    "TD3": ("TD3", TORQUES, SMALL | {"train_freq": (2, "episode")}),
    "DDPG": ("DDPG", TORQUES, SMALL),
    "DQN": ("DQN", spaces.Discrete(3), SMALL),
}


class Idle(gymnasium.Env):
    """Something to build an algorithm on; its episodes take five steps."""

    observation_space = OBSERVED

    def __init__(self, action_space: spaces.Space[Any]) -> None:
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.left -= 1
        return self.np_random.normal(size=3).astype(np.float32), -1.0, False, self.left == 0, {}


def learner_of(case: str) -> BaseAlgorithm:
    """As surrogym train makes it, and with weights that differ from a fresh one's, so that each of them counts."""
    algorithm, action_space, options = CASES[case]
    kwargs = {"features_extractor_class": Standardise, "features_extractor_kwargs": STATISTICS}
    own = PaperPolicy if algorithm in ("PPO", "A2C") else "MlpPolicy"
    made: BaseAlgorithm = getattr(stable_baselines3, algorithm)(
        own, Idle(action_space), device="cpu", seed=0, policy_kwargs=kwargs, **options
    )
    made.learn(16)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in made.policy.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return made


def saved(folder: Path, case: str) -> Path:
    save_policy(learner_of(case), folder / "policy.zip")
    return folder / "policy.zip"


def numbers(state: Any) -> list[Any]:
    """Every number of a nested state, in order."""
    if isinstance(state, dict):
        return [x for value in state.values() for x in numbers(value)]
    if isinstance(state, list | tuple):
        return [x for value in state for x in numbers(value)]
    return state.flatten().tolist() if isinstance(state, torch.Tensor) else [state]


@pytest.fixture
def no_unpickling(monkeypatch):
    def refused(*_: object) -> None:
        raise AssertionError("something was unpickled")

    monkeypatch.setattr(cloudpickle, "loads", refused)


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "the gift has run"


@pytest.mark.parametrize("case", CASES)
def test_a_policy_read_without_unpickling_gives_the_same_actions_as_an_unpickled_one(
    tmp_path: Path, monkeypatch, case: str
):
    policy, algorithm = saved(tmp_path, case), CASES[case][0]
    theirs = load_policy(policy, algorithm, trust=True)(OBSERVATIONS)
    monkeypatch.setattr(cloudpickle, "loads", lambda *_: pytest.fail("something was unpickled"))
    ours = load_policy(policy, algorithm)(OBSERVATIONS)
    assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
    np.testing.assert_array_equal(ours, theirs)
    assert len(np.unique(ours)) > 1, "a policy that always does the same shows nothing"


@pytest.mark.parametrize("case", CASES)
def test_an_algorithm_read_without_unpickling_trains_on_like_an_unpickled_one(tmp_path: Path, case: str):
    policy, (algorithm, action_space, _) = saved(tmp_path, case), CASES[case]
    learned = []
    for trust in (True, False):
        learner = load_learner(policy, algorithm, trust=trust, env=Idle(action_space), seed=3)
        learner.learn(40)
        rates = [getattr(learner, name)(0.4) for name in ("lr_schedule", "clip_range") if hasattr(learner, name)]
        frequency = getattr(learner, "train_freq", None)
        learned.append([*numbers(learner.get_parameters()), *rates, frequency, learner.num_timesteps])
    assert learned[0] == learned[1]


@pytest.mark.parametrize("algorithm", ["ppo", "fastppo"])
def test_policies_written_by_train_are_read_without_unpickling(tmp_path: Path, no_unpickling, algorithm: str):
    port, policy = ExactPendulum(), tmp_path / "policy"
    small = {"algorithm": algorithm, "total_steps": 256, "num_envs": 4, "hyperparameters": {"n_steps": 16}}
    train(port, policy, TrainSettings(**small))
    assert policy.is_file(), "under the name that was given"
    assert load_policy(policy)(np.zeros((2, 3), np.float32)).shape == (2, 1)
    train(port, tmp_path / "on.zip", TrainSettings(**small, start_from=policy))


@pytest.mark.parametrize("needs", ["load_policy", "load_learner", "export_policy", "train"])
def test_a_policy_file_with_pickled_objects_is_refused_by_every_reader(tmp_path: Path, mark: Path, needs: str):
    policy = gift(tmp_path / "policy.zip", mark)
    readers = {
        "load_policy": lambda: load_policy(policy),
        "load_learner": lambda: load_learner(policy, "PPO", env=Idle(TORQUES)),
        "export_policy": lambda: export_policy(policy, tmp_path / "policy.onnx", "PPO"),
        "train": lambda: train(ExactPendulum(), tmp_path / "on.zip", TrainSettings(start_from=policy)),
    }
    with pytest.raises(UnusablePolicy, match=r"holds pickled objects \(policy_class\).* give --trust-policy"):
        readers[needs]()
    assert not mark.exists()


def test_a_stable_baselines3_policy_is_read_only_if_trusted(tmp_path: Path):
    policy = tmp_path / "policy.zip"
    made = stable_baselines3.PPO("MlpPolicy", Idle(TORQUES), n_steps=8, batch_size=8, device="cpu")
    made.save(policy)
    with pytest.raises(UnusablePolicy, match=r"\(policy_class, observation_space, action_space\)"):
        load_policy(policy)
    expected = made.predict(OBSERVATIONS, deterministic=True)[0]
    np.testing.assert_array_equal(load_policy(policy, trust=True)(OBSERVATIONS), expected)


def test_a_trusted_policy_file_with_a_malicious_pickle_is_executed(tmp_path: Path, mark: Path):
    with pytest.raises(UnusablePolicy, match="not a policy of PPO"):
        load_policy(gift(tmp_path / "policy.zip", mark), trust=True)
    assert mark.exists(), "else the other tests would show nothing"


@pytest.mark.parametrize("name", ["policy_class", "lr_schedule", "learning_rate", "ep_info_buffer", "seed"])
def test_pickled_objects_in_the_settings_of_a_policy_file_are_not_unpickled(tmp_path: Path, mark: Path, name: str):
    policy = saved(tmp_path, "PPO, continuous")
    data = json.loads(read_entries(policy, LIMIT)["data"]) | {name: pickled(mark)}
    changed(policy, data=json.dumps(data).encode())
    if name == "seed":
        with pytest.raises(UnusablePolicy, match=r"pickled objects \(seed\)"):
            load_policy(policy)
    else:
        assert load_policy(policy)(OBSERVATIONS).shape == (200, 2)
    assert not mark.exists()


@pytest.mark.parametrize("trust", [False, True])
def test_pickled_objects_among_the_weights_of_a_policy_file_are_not_unpickled(tmp_path: Path, mark: Path, trust: bool):
    file = io.BytesIO()
    torch.save([Touches(mark), torch.zeros(10_000)], file)
    policy = changed(saved(tmp_path, "PPO, continuous"), policy__pth=file.getvalue())
    with pytest.raises(UnusablePolicy, match="expected weights that are numbers"):
        load_policy(policy, trust=trust)
    assert not mark.exists()


def test_an_unknown_learning_rate_schedule_is_refused_only_for_further_training(tmp_path: Path):
    learner = stable_baselines3.PPO(
        PaperPolicy, Idle(TORQUES), n_steps=8, batch_size=8, learning_rate=LinearSchedule(1, 0, 1), device="cpu"
    )
    save_policy(learner, tmp_path / "policy.zip")
    with pytest.raises(UnusablePolicy, match="policy_class"):
        load_policy(tmp_path / "policy.zip")  # without standardisation it is none of surrogym train
    learner = learner_of("PPO, continuous")
    learner.learning_rate = LinearSchedule(1e-3, 0, 1)
    save_policy(learner, tmp_path / "policy.zip")
    assert load_policy(tmp_path / "policy.zip")(OBSERVATIONS).shape == (200, 2)
    with pytest.raises(UnusablePolicy, match=r"pickled objects \(learning_rate\)"):
        load_learner(tmp_path / "policy.zip", "PPO", env=Idle(TORQUES))
    assert load_learner(tmp_path / "policy.zip", "PPO", env=Idle(TORQUES), learning_rate=1e-3).lr_schedule(1.0) == 1e-3


def bomb(name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(2**25))
    return file.getvalue()


def test_policy_weights_that_decompress_to_too_many_bytes_are_refused(tmp_path: Path):
    policy = changed(saved(tmp_path, "PPO, continuous"), policy__pth=bomb("archive/data/0"))
    assert policy.stat().st_size < 2**20
    with pytest.raises(UnusablePolicy, match=rf"expected at most \d+ bytes after decompression, got {2**25}"):
        load_policy(policy)


def test_a_policy_file_that_decompresses_to_too_many_bytes_is_refused(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("surrogym_trainer.policies.structure.MAX_BYTES", 2**20)
    (tmp_path / "policy.zip").write_bytes(bomb("policy.pth"))
    with pytest.raises(UnusablePolicy, match=f"expected at most {2**20} bytes after decompression, got {2**25}"):
        load_policy(tmp_path / "policy.zip")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"net_arch": {"pi": [100_000, 100_000], "vf": [1]}}, "expected the file to have 10000"),
        ({"action_space": {"kind": "discrete", "n": 10**9}}, "weights for its described layers, got at most "),
        ({"net_arch": {"pi": [7], "vf": [1]}}, "size mismatch|Missing key"),
        ({"policy": "Magic"}, "policy"),
        ({"extra": 1}, "extra"),
        ({"version": 2}, "version"),
    ],
)
def test_a_policy_file_whose_description_contradicts_its_weights_is_refused(
    tmp_path: Path, change: dict[str, Any], message: str
):
    policy = saved(tmp_path, "PPO, continuous")
    described = json.loads(read_entries(policy, LIMIT)[ENTRY])
    policy.write_bytes(stored(read_entries(policy, LIMIT) | {ENTRY: json.dumps(described | change).encode()}))
    with pytest.raises(UnusablePolicy, match=re.compile(f"is not a policy of PPO: .*({message})", re.DOTALL)):
        load_policy(policy)


def with_data(policy: Path, /, **settings: Any) -> Path:
    data = json.loads(read_entries(policy, LIMIT)["data"])
    return changed(policy, data=json.dumps(data | settings).encode())


def test_unknown_entries_of_a_policy_file_never_become_attributes_of_the_algorithm(tmp_path: Path):
    policy = saved(tmp_path, "PPO, continuous")
    expected = load_policy(policy)(OBSERVATIONS)
    gifts = dict.fromkeys(("predict", "learn", "policy", "get_env", "device", "verbose", "start_time"), "x")
    with_data(policy, **gifts, env=None, n_envs=10**6, _custom_logger=True, rollout_buffer_kwargs={"n_envs": 10**6})
    np.testing.assert_array_equal(load_policy(policy)(OBSERVATIONS), expected)
    learner = load_learner(policy, "PPO", env=Idle(TORQUES))
    learner.learn(16, reset_num_timesteps=False)
    assert (learner.n_envs, learner.verbose) == (1, 0)


def test_a_pickled_environment_in_a_policy_file_is_ignored(tmp_path: Path, mark: Path):
    policy = with_data(saved(tmp_path, "PPO, continuous"), env=pickled(mark))
    load_learner(policy, "PPO", env=Idle(TORQUES)).learn(16)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("case", "setting"),
    [("PPO, continuous", {"n_steps": 10**12}), ("SAC", {"buffer_size": 10**12}), ("DQN", {"buffer_size": 10**9})],
)
def test_a_too_large_replay_buffer_is_refused_only_for_further_training(
    tmp_path: Path, case: str, setting: dict[str, int]
):
    policy, (algorithm, action_space, _) = with_data(saved(tmp_path, case), **setting), CASES[case]
    assert len(load_policy(policy, algorithm)(OBSERVATIONS)) == len(OBSERVATIONS)
    with pytest.raises(
        UnusablePolicy, match=rf"expected at most {MAX_EXPERIENCE_BYTES} bytes of experience, got \d+ \("
    ):
        load_learner(policy, algorithm, env=Idle(action_space))
    load_learner(policy, algorithm, env=Idle(action_space), **dict.fromkeys(setting, 8))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"batch_size": "x"}, "batch_size: expected a whole number, got 'x'"),
        ({"n_epochs": 10**9}, "n_epochs: expected a number less than or equal to 10000, got 1000000000"),
        ({"gamma": float("nan")}, "gamma: expected a finite number, got nan"),
        ({"_n_updates": [1]}, "_n_updates: expected a whole number"),
    ],
    ids=str,
)
def test_the_error_for_a_policy_setting_of_wrong_type_names_it(tmp_path: Path, setting: dict[str, Any], message: str):
    with pytest.raises(UnusablePolicy, match=message):
        load_policy(with_data(saved(tmp_path, "PPO, continuous"), **setting))


def test_a_policy_file_with_variables_that_overwrite_its_weights_is_refused(tmp_path: Path):
    file = io.BytesIO()
    torch.save({"policy.log_std": torch.zeros(7)}, file)
    policy = changed(saved(tmp_path, "PPO, continuous"), pytorch_variables__pth=file.getvalue())
    with pytest.raises(
        UnusablePolicy, match=r"expected no other variables than log_ent_coef in the policy's file, got policy\.log_std"
    ):
        load_policy(policy)


@pytest.mark.parametrize("missing", ["data", "policy.pth"])
def test_an_incomplete_policy_file_is_refused_with_the_missing_entry(tmp_path: Path, missing: str):
    policy = saved(tmp_path, "PPO, continuous")
    entries = read_entries(policy, LIMIT)
    del entries[missing]
    policy.write_bytes(stored(entries))
    with pytest.raises(UnusablePolicy, match=f"expected an entry '{missing}' in the policy's file, got "):
        load_policy(policy)


def test_only_policy_networks_of_this_project_get_a_structure_description():
    plain = stable_baselines3.PPO("MlpPolicy", Idle(TORQUES), n_steps=8, batch_size=8, device="cpu")
    assert describe(plain) is None
    described = describe(learner_of("PPO, continuous"))
    assert described is not None
    assert Structure.model_validate_json(described.model_dump_json()) == described
    assert described.objects()["action_space"] == TORQUES


def test_a_server_address_from_a_policy_description_is_never_connected_to(tmp_path: Path):
    policy = tmp_path / "policy.zip"
    policy.touch()
    card = PolicyCard(server=NotedAddress("http://127.0.0.1:9"))
    write_card(policy, card)
    assert json.loads((tmp_path / "policy.json").read_text())["server"] == "http://127.0.0.1:9"
    assert read_card(policy) == card
    with pytest.raises(TypeError, match="NotedAddress"):
        Api(read_card(policy).server)  # type: ignore[arg-type]


def test_a_too_large_policy_description_is_refused_without_reading_all_of_it(tmp_path: Path):
    (tmp_path / "policy.zip").touch()
    with (tmp_path / "policy.json").open("wb") as card:
        card.truncate(2**28)
    tracemalloc.start()
    with pytest.raises(UnusablePolicy, match=f"not the card of a policy: expected at most {MAX_CARD_BYTES} bytes"):
        read_card(tmp_path / "policy.zip")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * MAX_CARD_BYTES


def test_a_plain_pickle_file_is_refused_as_policy(tmp_path: Path, mark: Path):
    (tmp_path / "policy.zip").write_bytes(pickle.dumps(Touches(mark)))
    with pytest.raises(UnusablePolicy, match="not a policy of PPO: expected a zip"):
        load_policy(tmp_path / "policy.zip")
    assert not mark.exists()
