"""Forged and damaged Minari data sets are refused in a sentence, before their arrays fill the memory."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from surrogym_sampler.logs import UnusableLog, read_log

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")
serialize_space = pytest.importorskip("minari.serialization").serialize_space

STEPS = 20
NAME = "forged/made-v0"
Change = Callable[[Any], None]


@pytest.fixture
def main_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The HDF5 file of a data set of two episodes."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rng, box = np.random.default_rng(0), gymnasium.spaces.Box
    episodes = [
        minari.data_collector.EpisodeBuffer(
            id=number,
            observations=rng.normal(size=(STEPS + 1, 2)).astype(np.float32),
            actions=rng.uniform(-1, 1, (STEPS, 1)).astype(np.float32),
            rewards=rng.normal(size=STEPS).tolist(),
            terminations=[False] * STEPS,
            truncations=[False] * (STEPS - 1) + [True],
        )
        for number in range(2)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it would like to know beside the steps
        minari.create_dataset_from_buffers(
            NAME, episodes, action_space=box(-1, 1, (1,)), observation_space=box(-9, 9, (2,))
        )
    return tmp_path / NAME / "data" / "main_data.hdf5"


def replaced(name: str, array: np.ndarray | None, episode: str = "episode_0") -> Change:
    """A change that gives an episode another array of a name, or none."""

    def change(file: Any) -> None:
        del file[episode][name]
        if array is not None:
            file[episode].create_dataset(name, data=array)

    return change


def without_an_episode(file: Any) -> None:
    del file["episode_1"]


def shifted(file: Any) -> None:
    """As many rewards as steps in all, but not in each episode."""
    replaced("rewards", np.zeros(STEPS - 1))(file)
    replaced("rewards", np.zeros(STEPS + 1), "episode_1")(file)


def without_ids(file: Any) -> None:
    """Both episodes have the same id, so that they were taken for one."""
    file["episode_1"].attrs["id"] = 0


def huge(file: Any) -> None:
    """24 GB of zeros in a few bytes."""
    replaced("rewards", None)(file)
    file["episode_0"].create_dataset("rewards", shape=(3 * 10**9,), chunks=(10**6,), compression="gzip", dtype="f8")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (replaced("rewards", None), "an episode that can't be read"),
        (replaced("observations", None), "an episode that can't be read"),
        (replaced("observations", np.zeros((STEPS + 1, 3), np.float32)), "an episode that can't be read"),
        (without_an_episode, "expected 2 episodes in .*, as its metadata say, got 1"),
        (replaced("rewards", np.zeros(STEPS, [("a", "f8"), ("b", "i4")])), "an episode that can't be read"),
        (replaced("rewards", np.array([b"1.0"] * STEPS)), "an episode that can't be read"),
        (replaced("actions", np.ones((STEPS, 1)) * 1j), "an episode that can't be read"),
        (replaced("actions", np.zeros((STEPS - 1, 1))), "in episode 0"),
        (shifted, "in episode 0"),
        (huge, "at most"),
    ],
)
def test_a_forged_minari_data_set_is_refused_in_a_sentence(main_file: Path, change: Change, says: str):
    """Missing arrays gave a traceback, 24 GB were read, and rewards that moved from one episode to the next were
    paired with other steps without a word."""
    assert len(read_log(NAME).steps) == 2 * STEPS
    with h5py.File(main_file, "a") as file:
        change(file)
    with pytest.raises(UnusableLog, match=says):
        read_log(NAME)


def test_episodes_of_one_id_remain_two(main_file: Path):
    with h5py.File(main_file, "a") as file:
        without_ids(file)
    assert len(set(read_log(NAME).table.columns["episode"])) == 2


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"total_episodes": 10**9}, "expected at most .* rows"),
        ({"total_episodes": 1}, "expected 1 episodes in .*, as its metadata say, got 2"),
        ({"total_episodes": "many"}, "with its number of episodes, got others"),
        ({"action_space": '{"type": "os.system"}'}, "metadata that can't be read"),
        ({"action_space": None}, "metadata that can't be read"),
        ({"data_format": "pickle"}, "metadata that can't be read"),
        ({"action_space": serialize_space(gymnasium.spaces.Box(-1, 1, (3,)))}, "an episode that can't be read"),
        ("[1]", "with its number of episodes, got others"),
        ("[" * 100_000, "with its number of episodes, got others"),
        ("x" * 2**25, "expected metadata of at most 16,777,216 bytes"),
    ],
)
def test_forged_metadata_of_a_minari_data_set_are_refused_in_a_sentence(main_file: Path, metadata: Any, says: str):
    """Tracebacks, minutes for a thousand million episodes, and actions of another width than declared."""
    file = main_file.with_name("metadata.json")
    forged = metadata if isinstance(metadata, str) else json.dumps({**json.loads(file.read_text()), **metadata})
    file.write_text(forged)
    with pytest.raises(UnusableLog, match=says):
        read_log(main_file.parent.parent)
