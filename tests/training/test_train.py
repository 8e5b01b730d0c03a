"""Training over any port: settings from the specification alone, the cap on virtual steps, and what is written."""

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

from support.models import learn
from support.real_steps import random_steps
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_sampler.original.loading import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.evaluation.imagined import observation_statistics
from surrogym_trainer.policies import UnusablePolicy, load_policy
from surrogym_trainer.policies.networks import WIDER, PaperPolicy
from surrogym_trainer.training import TrainingInterrupted, TrainProgress, TrainSettings, train
from surrogym_trainer.training.search import MAX_STEPS, SEARCHES, search_for
from surrogym_trainer.training.settings import even_batch, prolongs, suggested_gamma
from surrogym_trainer.training.stable_baselines import search as training
from surrogym_trainer.training.stable_baselines.algorithms import OffPolicySearch, OnPolicySearch
from surrogym_trainer.training.stable_baselines.search import imagined_returns_of

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 2}


def local(spec) -> LocalSurrogate:
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model)


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    return local(pendulum())


def small(**settings) -> TrainSettings:
    return TrainSettings(**{"algorithm": "PPO", "total_steps": 256, "num_envs": 8, "hyperparameters": SMALL} | settings)


def test_the_promised_return_of_an_earlier_policy_is_deleted_before_saving_a_new_one(surrogate, tmp_path: Path):
    """Else a kill between the two files leaves a new policy with an old verdict."""
    out = tmp_path / "policy.zip"
    out.with_suffix(".json").write_text('{"trusted": true, "virtual_steps": 1}')

    def occupy(_: TrainProgress) -> None:
        out.mkdir(exist_ok=True)

    with pytest.raises(OSError):
        train(surrogate, out, TrainSettings(algorithm="CMAES", total_steps=256), occupy)
    assert not out.with_suffix(".json").exists()


def test_training_writes_the_policy_and_its_settings(surrogate, tmp_path: Path):
    out, seen = tmp_path / "new" / "policy.zip", []
    result = train(surrogate, out, small(), seen.append)
    loaded = PPO.load(out, device="cpu")
    assert isinstance(loaded.policy, PaperPolicy)
    action, _ = loaded.predict(np.zeros((5, 3), np.float32), deterministic=True)
    assert np.abs(action).max() <= 2
    assert result.virtual_steps == 256
    assert result.lost_episodes == 0
    written = json.loads(out.with_suffix(".json").read_text())
    assert written["virtual_steps"] == 256
    assert written["settings"]["gamma"] == 0.985
    assert [p.steps for p in seen] == [128, 256]
    assert all(isinstance(p, TrainProgress) and p.total_steps == 256 for p in seen)


@pytest.mark.parametrize(("total", "taken"), [(128, 128), (255, 128), (300, 256), (1, 128)])
def test_training_takes_whole_rollouts_within_the_total_number_of_steps(surrogate, tmp_path: Path, total, taken):
    result = train(surrogate, tmp_path / "policy.zip", small(total_steps=total))
    assert result.virtual_steps == result.settings["total_steps"] == taken


def test_training_with_the_same_seed_gives_the_same_policy(surrogate, tmp_path: Path):
    def weights(seed: int, name: str) -> np.ndarray:
        train(surrogate, tmp_path / name, small(seed=seed, total_steps=128))
        policy = PPO.load(tmp_path / name, device="cpu").policy
        return np.concatenate([p.detach().numpy().ravel() for p in policy.parameters()])

    one = weights(0, "a.zip")
    np.testing.assert_array_equal(one, weights(0, "b.zip"))
    assert not np.array_equal(one, weights(1, "c.zip"))


def test_training_continues_from_a_saved_policy(surrogate, tmp_path: Path):
    first, second = tmp_path / "first.zip", tmp_path / "second.zip"
    before = train(surrogate, first, small(total_steps=128))
    after = train(surrogate, second, small(total_steps=128, start_from=first))
    assert after.imagined_return >= before.imagined_return, "the policy it started from is one of those compared"
    env = SurrogateVecEnv.from_port(surrogate, 2)
    fresh = PPO(PaperPolicy, env, device="cpu", policy_kwargs={"net_arch": WIDER}).policy
    env.close()
    one, two = (PPO.load(path, device="cpu").policy for path in (first, second))
    assert distance(one, two) < 0.3 * distance(one, fresh)


def test_given_training_settings_override_those_saved_with_the_policy(surrogate, tmp_path: Path):
    first, second = tmp_path / "first.zip", tmp_path / "second.zip"
    train(surrogate, first, small(total_steps=128))
    asked = SMALL | {"learning_rate": 1e-5, "n_steps": 32, "ent_coef": 0.01}
    result = train(surrogate, second, small(total_steps=256, start_from=first, hyperparameters=asked))
    after = PPO.load(second, device="cpu")
    assert (after.learning_rate, after.n_steps, after.ent_coef, after.n_epochs) == (1e-5, 32, 0.01, 2)
    assert {name: result.settings[name] for name in asked} == asked


def test_the_error_for_a_start_policy_that_does_not_fit_names_the_difference(surrogate, tmp_path: Path):
    first = tmp_path / "first.zip"
    train(surrogate, first, small(total_steps=128))
    for changes in ({"n_steps": "many"}, {"device": "moon"}):
        with pytest.raises(UnusablePolicy, match=f"first.zip does not fit {next(iter(changes))}="):
            train(surrogate, tmp_path / "policy.zip", small(start_from=first, hyperparameters=changes))
    with pytest.raises(UnusablePolicy, match=r"first.zip does not fit .*this surrogate: .*spaces do not match"):
        train(local(cartpole()), tmp_path / "policy.zip", small(start_from=first))


def test_training_refuses_to_continue_a_policy_of_another_algorithm(surrogate, tmp_path: Path):
    a_search = tmp_path / "search.zip"
    few = {"population": 4, "starts": 2, "units": 2}
    train(surrogate, a_search, TrainSettings(algorithm="cmaes", total_steps=1, hyperparameters=few))
    (tmp_path / "a.txt").write_text("text")
    for path in (a_search, tmp_path / "a.txt"):
        with pytest.raises(UnusablePolicy, match=f"{path.name} is not a policy of PPO"):
            train(surrogate, tmp_path / "policy.zip", small(start_from=path))
    assert not (tmp_path / "policy.zip").exists()


def distance(a: PaperPolicy, b: PaperPolicy) -> float:
    pairs = zip(a.parameters(), b.parameters(), strict=True)
    return sum(float((p - q).detach().square().sum()) for p, q in pairs) ** 0.5


def test_the_info_of_an_ended_episode_contains_its_total_penalty(surrogate):
    env, taken = SurrogateVecEnv.from_port(surrogate, 2, seed=0, penalty=100.0, time_limit=4), np.zeros(2)
    env.reset()
    for _ in range(4):
        _, reward, _, infos = env.step(np.zeros((2, 1)))
        taken += [info["reward_mean"] for info in infos] - reward
    env.close()
    np.testing.assert_allclose([info["penalty"] for info in infos], taken, rtol=1e-5)


def test_training_reports_the_uncertainty_penalty(surrogate, tmp_path: Path):
    reports = []
    for penalty in (0.0, 100.0):
        session = {"penalty": penalty, "time_limit": 4}
        result = train(surrogate, tmp_path / "policy.zip", small(session=session, total_steps=128), reports.append)
    free, penalised = reports[0], reports[-1]
    assert free.penalty_share == pytest.approx(0, abs=1e-6)
    assert free.episode_penalty is None
    assert penalised.penalty_share > 1e-3
    assert result.episode_penalty == penalised.episode_penalty > 0


@pytest.mark.parametrize("session", [{"variant": "pathwise"}, {"trust": 0.1}, {"process_noise": True}])
def test_training_works_with_every_session_variant(surrogate, tmp_path: Path, session):
    result = train(surrogate, tmp_path / "policy.zip", small(session=session, total_steps=128))
    assert result.settings["session"] == session
    assert result.virtual_steps == 128


def test_training_keeps_the_policy_with_the_best_imagined_return(surrogate, tmp_path: Path):
    seen: list[float] = []
    ruinous = {"learning_rate": 0.3}  # every update throws away what was learned
    settings = small(total_steps=512, hyperparameters=SMALL | ruinous)
    result = train(surrogate, tmp_path / "policy.zip", settings, lambda p: seen.append(p.imagined_return))
    kept = PPO.load(result.path, device="cpu")
    assert result.imagined_return >= max(seen)
    assert imagined_returns_of(surrogate, kept, settings).mean() == pytest.approx(result.imagined_return)


def test_imagined_returns_are_over_whole_episodes_from_the_declared_starts(surrogate):
    def nothing(observation: np.ndarray) -> np.ndarray:
        return np.zeros((len(observation), 1), np.float32)

    returns = imagined_returns(surrogate, nothing, 8, seed=3)
    assert returns.shape == (8,)
    assert ((returns > -2_000) & (returns < -400)).all(), "a free pendulum earns that in 200 steps"
    np.testing.assert_array_equal(returns, imagined_returns(surrogate, nothing, 8, seed=3, start_box=1.0, trust=1e-9))
    np.testing.assert_array_equal(returns, imagined_returns(surrogate, nothing, 8, seed=3, start_visited=1.0))
    assert not surrogate._sessions


@pytest.mark.parametrize(("preset", "hidden"), [("default", [64, 64]), ("paper", [32])])
def test_the_papers_policy_network_is_used_only_with_preset_paper(tmp_path: Path, preset, hidden):
    spec = make("Pendulum-v1", preset=preset).spec()
    result = train(local(spec), tmp_path / "policy.zip", small(total_steps=128))
    network = PPO.load(result.path, device="cpu").policy.mlp_extractor.policy_net
    assert [layer.out_features for layer in network if hasattr(layer, "out_features")] == hidden


def test_training_works_with_discrete_actions(tmp_path: Path):
    result = train(local(cartpole()), tmp_path / "policy.zip", small())
    assert result.virtual_steps == 256
    assert result.imagined_return is not None
    action, _ = PPO.load(result.path, device="cpu").predict(np.zeros((5, 4), np.float32), deterministic=True)
    assert set(action.tolist()) <= {0, 1}


@pytest.mark.parametrize("algorithm", ["A2C", "sac", "TD3"])
def test_other_stable_baselines3_algorithms_can_be_trained_by_name(surrogate, tmp_path: Path, algorithm):
    hyperparameters = {"n_steps": 8} if algorithm == "A2C" else {"learning_starts": 32, "batch_size": 16}
    settings = small(algorithm=algorithm, num_envs=4, total_steps=64, hyperparameters=hyperparameters)
    result = train(surrogate, tmp_path / "policy.zip", settings)
    assert result.virtual_steps == 64
    assert SEARCHES.get(algorithm).algorithm.load(tmp_path / "policy.zip", device="cpu") is not None


def test_dqn_trains_on_one_discrete_action_and_sac_refuses_it(tmp_path: Path):
    surrogate, quick = local(cartpole()), {"learning_starts": 32, "batch_size": 16}
    settings = small(algorithm="dqn", num_envs=4, total_steps=64, hyperparameters=quick)
    result = train(surrogate, tmp_path / "policy.zip", settings)
    assert load_policy(result.path, "dqn")(np.zeros((5, 4), np.float32)).shape == (5,)
    with pytest.raises(ValueError, match=r"SAC can't be trained in this surrogate: .*Discrete"):
        train(surrogate, tmp_path / "policy.zip", small(algorithm="SAC", hyperparameters=quick))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"algorithm": "DreamerV9"}, r"algorithm: expected one of .*PPO.*, got 'DreamerV9'"),
        ({"algorithm": "VecEnv"}, "got 'VecEnv'"),
        ({"algorithm": "DQN"}, "DQN can't be trained in this surrogate"),
        ({"hyperparameters": {"learning_speed": 1}}, "PPO can't be trained in this surrogate"),
        ({"total_steps": 0}, f"expected 1 to {MAX_STEPS}, got 0"),
        ({"total_steps": MAX_STEPS + 1}, f"expected 1 to {MAX_STEPS}, got {MAX_STEPS + 1}"),
    ],
)
def test_invalid_training_settings_are_refused(surrogate, tmp_path: Path, settings, complaint):
    with pytest.raises(ValueError, match=complaint):
        train(surrogate, tmp_path / "policy.zip", small(**settings))
    assert not list(tmp_path.iterdir())
    assert not surrogate._sessions, "every session was closed"


def test_default_training_settings_follow_from_the_specification(surrogate):
    assert suggested_gamma(pendulum()) == pytest.approx(0.985)
    assert suggested_gamma(cartpole()) == pytest.approx(0.994)
    assert suggested_gamma(pendulum().model_copy(update={"time_limit": 20})) == 0.9
    assert suggested_gamma(pendulum().model_copy(update={"time_limit": None})) == pytest.approx(0.997)
    assert OnPolicySearch.lanes > OffPolicySearch.lanes


@pytest.mark.parametrize(("rollout", "batch"), [(8_192, 1_024), (128, 128), (1_536, 1_536), (3_072, 1_024), (1, 1)])
def test_the_default_batch_size_divides_the_rollout_length(rollout, batch):
    assert even_batch(rollout) == batch


def test_observation_statistics_are_computed_over_the_sampling_range(surrogate):
    mean, deviation = observation_statistics(surrogate, seed=0)
    np.testing.assert_allclose(mean, [0, 0, 0], atol=0.5)
    np.testing.assert_allclose(deviation, [0.5**0.5, 0.5**0.5, 16 / 12**0.5], rtol=0.1)
    assert not surrogate._sessions


IDLE = SMALL | {"learning_rate": 0.0, "n_steps": 4}  # learns nothing


def test_ctrl_c_before_the_first_rollout_leaves_an_untrained_policy(surrogate, tmp_path: Path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(SurrogateVecEnv, "reset", interrupted)
    with pytest.raises(TrainingInterrupted) as interruption:
        train(surrogate, tmp_path / "policy.zip", small())
    assert interruption.value.result.virtual_steps == 0
    assert load_policy(tmp_path / "policy.zip")(np.zeros((1, 3), np.float32)).shape == (1, 1)


@pytest.mark.parametrize(
    "settings",
    [
        small(),
        TrainSettings("FASTPPO", 10_000),
        TrainSettings("CMAES", 40_000, hyperparameters={"population": 4, "starts": 2}),
    ],
    ids=["PPO", "FASTPPO", "CMAES"],
)
def test_an_error_in_a_training_leaves_the_policy_so_far(surrogate, tmp_path: Path, settings: TrainSettings):
    """A simulator that failed after hours lost all of them."""
    left = iter([None, RuntimeError("the solver did not converge")])

    def fail(_: TrainProgress) -> None:
        if error := next(left):
            raise error

    out = tmp_path / "policy.zip"
    with pytest.raises(RuntimeError, match="did not converge") as raised:
        train(surrogate, out, settings, fail)
    assert f"the policy so far is in {out}" in raised.value.__notes__[0]
    assert load_policy(out, settings.algorithm)(np.zeros((1, 3), dtype=np.float32)).shape[0] == 1
    assert json.loads(out.with_suffix(".json").read_text())["virtual_steps"] > 0


def test_a_training_without_given_steps_may_be_extended_except_with_preset_paper():
    default, paper = pendulum(), make("Pendulum-v1", preset="paper").spec()
    assert prolongs(TrainSettings(), default)
    assert not prolongs(TrainSettings(total_steps=1_000), default)
    assert not prolongs(TrainSettings(), paper)
    assert prolongs(TrainSettings(total_steps=1_000, prolong=True), paper)


@pytest.mark.parametrize("earned", [40.0, 160.0], ids=["less", "more"])
def test_with_option_anew_the_saved_policy_is_kept_if_a_new_network_earns_less(
    surrogate, tmp_path: Path, monkeypatch, earned: float
):
    """An untrained network earns nothing, the saved policy 100."""
    saved = tmp_path / "saved.zip"
    train(surrogate, saved, small(total_steps=128))
    returns = itertools.chain([0.0, 100.0], itertools.repeat(earned))
    monkeypatch.setattr(training, "imagined_returns_of", lambda *_: np.full(4, next(returns)))
    result = train(surrogate, tmp_path / "policy.zip", small(total_steps=128, start_from=saved, anew=True, seed=1))
    assert result.imagined_return == max(earned, 100.0)
    one, two = (PPO.load(path, device="cpu").policy for path in (saved, result.path))
    assert (distance(one, two) == 0) is (earned < 100)


def test_stable_baselines3_ppo_refuses_the_setting_prolong(surrogate):
    with pytest.raises(ValueError, match="PPO trains for a fixed number of steps"):
        search_for(small(prolong=True))


def test_policies_are_compared_under_the_given_evaluation_settings_and_not_those_of_training(surrogate, tmp_path: Path):
    session = {"time_limit": 4}
    asked = small(session=session, judge={"variant": "pathwise", "time_limit": 3})
    result = train(surrogate, tmp_path / "policy.zip", asked)
    kept = PPO.load(result.path, device="cpu")
    assert imagined_returns_of(surrogate, kept, asked).mean() == pytest.approx(result.imagined_return)
    assert imagined_returns_of(surrogate, kept, small(session=session)).mean() < result.imagined_return, (
        "a fourth cost more"
    )


@pytest.mark.parametrize("threads", [0, 10**9, 1.5, True])
def test_a_training_with_an_absurd_number_of_threads_is_refused(threads: Any):
    """Torch would start them, and the process end."""
    with pytest.raises(ValueError, match="threads: expected a whole number from 1 to 1024, got"):
        TrainSettings(threads=threads)


def test_the_default_policy_search_imports_neither_torch_nor_stable_baselines3():
    """They take some three seconds of a core to import, at the start of every training."""
    program = """
import sys
import surrogym_trainer.training.audited
import surrogym_trainer.training.fast_ppo.search
print(*sorted({"torch", "stable_baselines3"} & {*sys.modules}))
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == []
