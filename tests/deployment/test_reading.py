"""A controller decides as its policy does, and a policy that can't become one is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from support.controllers import LEARNERS, Idle, holding, learner, network, plant
from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.errors import PolicyMisfit
from surrogym_sampler.original.lags import begun, followed, read_names
from surrogym_shared.spec import DiscreteAction
from surrogym_shared.terms import observe as declared
from surrogym_trainer.deployment.controller import LATE, NOT_FINITE, OUT_OF_RANGE, Choices, NotDeployable
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import begin, decide, observe
from surrogym_trainer.policies import UnusablePolicy, load_policy
from surrogym_trainer.policies.card import PolicyCard, card_path, write_card
from surrogym_trainer.policies.integrals import acting_with_integrals

ANY = Choices(fallback=(0.0,))
HISTORY = {"changes": 2, "actions": 2, "largest": {"angle": 0.5, "slide": 0.2}, "at_start": {"angle": 0.3}}


def readings(spec, steps, seed=0):
    """Measurements (T, R) of a walk that turns round and passes the slide's bounds."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(0, [0.8, 0.4, 0.0], (steps, 3)), axis=0).clip([-50, -2.0, 0], [50, 3.0, 1])


@pytest.mark.parametrize("case", LEARNERS)
def test_a_controller_gives_the_actions_of_its_policy_in_every_step(tmp_path: Path, case: str):
    spec = plant(LEARNERS[case][2], **HISTORY)
    path = learner(tmp_path, case, spec)
    fallback = None if spec.action.kind == "box" else (0.0,) * spec.action.size
    controller = controller_of(path, trust=True, choices=Choices(fallback=fallback))
    policy, memory, q, last = load_policy(path, LEARNERS[case][0], trust=True), begin(controller), None, None
    chosen = []
    for read in readings(spec, 60):
        q = begun(spec, read) if q is None else followed(spec, q, last, read)
        decided = decide(controller, memory, read[None])
        expected = decode_actions(spec, policy(declared(spec, q[None]).astype(np.float32)), 1)[0]
        assert decided.status == 0
        np.testing.assert_array_equal(decided.memory.coordinates[0], q)
        np.testing.assert_allclose(decided.action[0], expected, atol=1e-4 * np.ptp([controller.low, controller.high]))
        memory, last = decided.memory, decided.action[0].astype(np.float32).astype(np.float64)
        chosen.append(expected)
    assert len(np.unique(chosen)) > 1, "a policy that always does the same shows nothing"
    np.testing.assert_array_equal(observe(controller, q[None]), declared(spec, q[None]).astype(np.float32))
    assert [m.name for m in controller.measurements] == list(read_names(spec))


def test_a_linear_policy_and_a_network_of_arrays_become_controllers(tmp_path: Path):
    for units in (0, (8,), (64, 64)):
        spec = plant()
        path = network(tmp_path, spec, units)
        controller, read = controller_of(path), readings(spec, 1)
        decided = decide(controller, begin(controller), read)
        policy = load_policy(path)
        np.testing.assert_allclose(
            decided.action, decode_actions(spec, policy(declared(spec, begun(spec, read[0])[None])), 1), atol=1e-6
        )
        assert controller.timeout == 0.1
        assert len(controller.decision.layers) == (len(units) if units else 0) + 1


@pytest.mark.parametrize(
    ("read", "age", "status"),
    [
        ([np.nan, 0, 0], 0, NOT_FINITE),
        ([0, np.inf, 0], 0, NOT_FINITE),
        ([0, 5.1, 0], 0, OUT_OF_RANGE),
        ([0, 0, -1.1], 0.101, OUT_OF_RANGE | LATE),
        ([0, 0, 0], 0.101, LATE),
        ([0, 0, 0], np.nan, LATE),
        ([0, 0, 0], -0.001, LATE),
        ([700.0, 0, 0], 0, OUT_OF_RANGE),
        ([600.0, 4.9, 1.9], 0.1, 0),
    ],
)
def test_an_invalid_measurement_makes_the_controller_return_its_fallback_action(tmp_path: Path, read, age, status):
    controller = controller_of(network(tmp_path, plant()), choices=Choices(fallback=(0.5, 1.5)))
    decided = decide(controller, begin(controller), np.array([read]), age)
    assert decided.status == status
    assert (decided.action.tolist() == [[0.5, 1.5]]) == (status != 0)


def test_after_a_measurement_fault_only_measurement_lags_are_reset(tmp_path: Path):
    spec = plant(**HISTORY)
    controller = controller_of(network(tmp_path, spec))
    names, memory = spec.coordinate_names, begin(controller)
    walk = readings(spec, 6)
    walk[3] = np.nan
    rows, actions = [], []
    for read in walk:
        decided = decide(controller, memory, read[None])
        memory = decided.memory
        rows.append(dict(zip(names, memory.coordinates[0], strict=True)))
        actions.append(memory.action[0])
    assert actions[3].tolist() == [0.0, 0.0], "the fallback"
    assert rows[4]["slide.change1"] == rows[4]["steps since reset"] == 0
    assert rows[5]["slide.change1"] == pytest.approx(rows[5]["slide"] - rows[4]["slide"])
    assert [rows[4]["action1.lag1"], rows[4]["action1.lag2"]] == [actions[3][1], actions[2][1]]
    assert rows[2]["action1.lag1"] == actions[1][1] != 0


def test_a_controller_sums_the_errors_that_its_policy_sees_and_a_fault_holds_the_sum(tmp_path: Path):
    spec, points = holding(plant(**HISTORY)), {"slide": 0.7}
    path = network(tmp_path, spec, settings={"integral": ("slide",), "session": {"set_points": points}})
    controller, predict = controller_of(path), load_policy(path)
    policy = acting_with_integrals(predict, spec, ("slide",), points)
    memory, q, last, sums = begin(controller), None, None, []
    rng = np.random.default_rng(3)
    for turn in range(60):
        read = np.array([rng.uniform(-3, 3), 0.7 + 0.2 * np.sin(turn / 5), 0.5])
        q = begun(spec, read) if q is None else followed(spec, q, last, read)
        decided = decide(controller, memory, read[None])
        shown = declared(spec, q[None]).astype(np.float32)
        expected = decode_actions(spec, policy.actions([0], shown), 1)[0]
        np.testing.assert_allclose(decided.action[0], expected, atol=1e-4 * np.ptp([controller.low, controller.high]))
        memory, last = decided.memory, decided.action[0].astype(np.float32).astype(np.float64)
        sums.append(memory.coordinates[0, -1])
    assert sums[0] == 0
    assert sums[1] == pytest.approx(0.2 * np.sin(0.2) / (0.05 * 3))
    assert max(sums) == 1
    assert min(sums) == -1
    faulty = decide(controller, memory, np.full((1, 3), np.nan)).memory
    assert faulty.coordinates[0, -1] == sums[-1]
    assert "integral of slide" in controller.coordinates


def test_deploying_a_policy_without_a_feed_forward_network_is_refused(tmp_path: Path):
    spec = plant()
    path = network(tmp_path, spec)
    (tmp_path / "policy.onnx").write_bytes(b"x")
    with pytest.raises(NotDeployable, match="feed-forward network can"):
        controller_of(tmp_path / "policy.onnx", spec)
    made = stable_baselines3.PPO("MlpPolicy", Idle(spec), device="cpu", policy_kwargs={"activation_fn": torch.nn.ELU})
    made.save(path)
    write_card(path, PolicyCard(algorithm="PPO", spec=spec))
    with pytest.raises(NotDeployable, match="got ELU; a deterministic feed-forward network can"):
        controller_of(path, trust=True)
    with pytest.raises(NotDeployable, match=r"pickled objects.*feed-forward network can"):
        controller_of(path)
    with pytest.raises(NotDeployable, match="is not a policy of DQN: expected --algorithm PPO"):
        controller_of(path, algorithm="DQN", trust=True)
    with pytest.raises(NotDeployable, match=r"RECURRENTPPO.*feed-forward network can"):
        controller_of(path, algorithm="RECURRENTPPO", trust=True)
    torch.save({"weight": torch.zeros(3)}, path)
    with pytest.raises(NotDeployable, match=r"is not a policy of PPO.*feed-forward network can"):
        controller_of(path)


def test_a_controller_contains_the_digests_of_its_policy_and_model(tmp_path: Path):
    spec = plant()
    path = network(tmp_path, spec)
    write_card(path, PolicyCard(spec=spec, model="5a" * 32))
    digests = controller_of(path).digests
    assert digests["policy"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert digests["samples of the model"] == "5a" * 32


def test_deploying_a_policy_with_nan_weights_is_refused(tmp_path: Path):
    for gain, refused in ((np.nan, UnusablePolicy), (1e200, NotDeployable)):
        path = network(tmp_path, plant(), (8,), gain)
        with pytest.raises(refused, match="finite numbers"):
            controller_of(path)


def test_deploying_a_too_large_network_is_refused(tmp_path: Path):
    with pytest.raises(NotDeployable, match="at most 1,000,000 weights, got 1,008,002, which need 8 MB"):
        controller_of(network(tmp_path, plant(), (1000, 1000), 0.01))


def test_a_controller_keeps_the_normalisation_and_clipping_of_vecnormalize(tmp_path: Path):
    spec, path = plant(), tmp_path / "policy.zip"
    env = VecNormalize(DummyVecEnv([lambda: Idle(spec)]))
    made = stable_baselines3.PPO("MlpPolicy", env, device="cpu", n_steps=8, batch_size=8, seed=0)
    made.learn(8).save(path)
    write_card(path, PolicyCard(algorithm="PPO", spec=spec))
    statistics = {"mean": np.arange(4.0), "var": np.full(4, 4.0), "epsilon": 1e-8, "clip": 0.5}
    np.savez(tmp_path / "policy.vecnormalize.npz", **statistics)
    controller, policy = controller_of(path, trust=True), load_policy(path, trust=True)
    reads = readings(spec, 20)
    shown = declared(spec, np.stack([begun(spec, read) for read in reads])).astype(np.float32)
    decided = decide(controller, begin(controller, 20), reads)
    np.testing.assert_allclose(decided.action, decode_actions(spec, policy(shown), 20), atol=1e-5)


def test_deployment_options_that_do_not_fit_the_policy_are_refused(tmp_path: Path):
    path = network(tmp_path, plant())
    for wrong, words in [
        (Choices(fallback=(0.0,)), "--fallback: expected 2 entries"),
        (Choices(fallback=(0.0, 11.0)), r"got \[0.0, 11.0\]"),
        (Choices(timeout=0.0), "--timeout: expected 1e-06 s"),
        (Choices(ranges={"speed": (0.0, 1.0)}), r"angle, slide, target\), got speed"),
        (Choices(ranges={"slide": (1.0, 1.0)}), "range of slide: .* got 1 to 1"),
        (Choices(ranges={"slide": (0.0, np.inf)}), "range of slide: .* got 0 to inf"),
        (Choices(ranges={"slide": (0.0, 1e39)}), r"within -1e\+37 to 1e\+37, got 0 to 1e\+39"),
        (Choices(timeout=1e38), r"--timeout: expected 1e-06 s to 1e\+37 s, got 1e\+38"),
        (Choices(period=1e-9), "--period: expected 1e-06 s"),
    ]:
        with pytest.raises(NotDeployable, match=words):
            controller_of(path, choices=wrong)
    discrete = network(tmp_path, plant(DiscreteAction(n=3)))
    with pytest.raises(NotDeployable, match="expected --fallback with 1 of the numbers"):
        controller_of(discrete)
    assert controller_of(discrete, choices=Choices(fallback=(2.0,))).fallback == 2
    with pytest.raises(PolicyMisfit, match="expected coordinates"):
        controller_of(network(tmp_path, plant()), plant(DiscreteAction(n=3)), choices=ANY)
    card_path(network(tmp_path, plant())).unlink()
    with pytest.raises(NotDeployable, match="network of 4 inputs and 3 outputs for this specification, got 4 and 2"):
        controller_of(path, plant(DiscreteAction(n=3)), choices=ANY)


def test_deploying_a_policy_file_with_a_wrong_checksum_is_refused(tmp_path: Path):
    path = network(tmp_path, plant())
    path.write_bytes(bytes(b ^ 0xFF if 200 < i < 260 else b for i, b in enumerate(path.read_bytes())))
    with pytest.raises(UnusablePolicy, match="not a policy of"):
        controller_of(path)
