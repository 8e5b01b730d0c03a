"""Public formats of logged episodes, as their authors define them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import UnusableLog, read_log

LENGTHS = (6, 4, 5)  # observations of each episode
TERMINAL = (True, False, True)


def episodes(seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Observations (T + 1, 2), actions (T, 1) and rewards (T,) of each episode."""
    rng = np.random.default_rng(seed)
    return [
        {"obs": rng.normal(size=(n, 2)), "acts": rng.uniform(-1, 1, (n - 1, 1)), "rews": rng.normal(size=n - 1)}
        for n in LENGTHS
    ]


def rlds(found: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Steps of RLDS. The action and reward of each last step mean nothing, and are far from all others."""
    return {
        "observation": np.concatenate([one["obs"] for one in found]),
        "action": np.concatenate([np.append(one["acts"], [[77.0]], 0) for one in found]),
        "reward": np.concatenate([np.append(one["rews"], -999.0) for one in found]),
        "discount": np.ones(sum(LENGTHS)),
        "is_first": np.concatenate([np.arange(n) == 0 for n in LENGTHS]),
        "is_last": np.concatenate([np.arange(n) == n - 1 for n in LENGTHS]),
        "is_terminal": np.concatenate(
            [(np.arange(n) == n - 1) & end for n, end in zip(LENGTHS, TERMINAL, strict=True)]
        ),
    }


def test_an_rlds_log_gives_each_step_its_own_reward_and_termination(tmp_path: Path):
    found = episodes()
    np.savez(tmp_path / "log.npz", **rlds(found))
    log = read_log(tmp_path / "log.npz")
    np.testing.assert_array_equal(log.steps.q, np.concatenate([one["obs"][:-1] for one in found]))
    np.testing.assert_array_equal(log.steps.q_next, np.concatenate([one["obs"][1:] for one in found]))
    np.testing.assert_array_equal(log.steps.u, np.concatenate([one["acts"] for one in found]))
    np.testing.assert_array_equal(log.reward, np.concatenate([one["rews"] for one in found]))
    assert np.flatnonzero(log.steps.terminated).tolist() == [4, 11]
    assert np.flatnonzero(log.steps.truncated).tolist() == [7]
    assert (log.rejected, log.steps.episodes) == ([], (5, 3, 4))


def test_an_rlds_log_as_csv_gives_the_same_steps_as_npz(tmp_path: Path):
    arrays = rlds(episodes())
    np.savez(tmp_path / "log.npz", **arrays)
    heading = "obs.s0,obs.s1,action,reward,is_first,is_last,is_terminal"
    cells = [*arrays["observation"].T, arrays["action"][:, 0], arrays["reward"]]
    marks = [arrays[name] for name in ("is_first", "is_last", "is_terminal")]
    lines = [
        ",".join([*map(repr, map(float, row[:4])), *map(str, row[4:])]) for row in zip(*cells, *marks, strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join([heading, *lines]))
    assert read_log(tmp_path / "log.csv").steps.digest == read_log(tmp_path / "log.npz").steps.digest


@pytest.mark.parametrize(
    ("mark", "row", "says"),
    [
        ("is_first", 6, "is_first to be 1 in the first row and after"),
        ("is_terminal", 2, "is_terminal only where is_last"),
    ],
)
def test_contradicting_episode_flags_of_an_rlds_log_are_refused(tmp_path: Path, mark: str, row: int, says: str):
    arrays = rlds(episodes())
    arrays[mark][row] = not arrays[mark][row]
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(UnusableLog, match=says):
        read_log(tmp_path / "log.npz")


def test_a_d4rl_log_ends_episodes_at_terminals_and_timeouts(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(12, 2)).astype(np.float32)
    terminals, timeouts = (np.isin(np.arange(12), ends) for ends in ([3], [7, 11]))
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        file["observations"], file["actions"] = observations, rng.uniform(-1, 1, (12, 1))
        file["rewards"], file["terminals"], file["timeouts"] = rng.normal(size=12), terminals, timeouts
        file["infos/qpos"], file["metadata/algorithm"] = rng.normal(size=(12, 3)), "SAC"
    log = read_log(tmp_path / "log.hdf5")
    paired = dict(zip(log.steps.row.tolist(), log.steps.q_next.tolist(), strict=True))
    assert {0, 1, 2, 4, 5, 6, 8, 9, 10} <= set(paired)
    for row in (0, 1, 2, 4, 5, 6, 8, 9, 10):
        assert paired[row] == observations[row + 1].tolist()
    assert not {7, 11} & set(paired), "the observation after a timeout is of another episode"
    assert {"infos", "metadata"} <= set(log.ignored)


def test_stable_baselines3_dones_at_timeouts_are_read_as_truncation(tmp_path: Path):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(11, 2))
    arrays = {"observations": states[:-1], "next_observations": states[1:], "actions": rng.normal(size=(10, 1))}
    dones, timeouts = (np.isin(np.arange(10), ends) for ends in ([4, 9], [9]))
    np.savez(tmp_path / "log.npz", **arrays, rewards=rng.normal(size=10), dones=dones, timeouts=timeouts)
    log = read_log(tmp_path / "log.npz")
    assert np.flatnonzero(log.steps.terminated).tolist() == [4]
    assert np.flatnonzero(log.steps.truncated).tolist() == [9]


def test_a_log_with_episode_start_flags_is_split_into_episodes(tmp_path: Path):
    rng = np.random.default_rng(0)
    starts = np.isin(np.arange(12), [0, 5])
    arrays = {"obs": rng.normal(size=(12, 2)), "acts": rng.normal(size=(12, 1)), "rews": rng.normal(size=12)}
    np.savez(tmp_path / "log.npz", **arrays, episode_starts=starts)
    log = read_log(tmp_path / "log.npz")
    assert log.steps.episodes == (5, 7)
    np.testing.assert_array_equal(log.reward, arrays["rews"][log.steps.row])


def test_an_rlds_log_without_a_step_is_refused(tmp_path: Path):
    np.savez(tmp_path / "log.npz", **{name: cells[:1] for name, cells in rlds(episodes()).items()})
    with pytest.raises(UnusableLog, match="expected steps of RLDS, got none"):
        read_log(tmp_path / "log.npz")


@pytest.mark.parametrize("name", ["is_last", "is_terminal"])
def test_an_rlds_log_with_a_single_episode_flag_is_refused_with_a_question(tmp_path: Path, name: str):
    """Whether the row's own step ended, or the one before, can't be known."""
    arrays = {key: cells for key, cells in rlds(episodes()).items() if not key.startswith("is_") or key == name}
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(UnusableLog, match=f"'{name}' is likely the terminated"):
        read_log(tmp_path / "log.npz")
