"""Test functions for model families. The laws are in the docstrings of ``models.port``."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor

from surrogym_server.engine.design_job import fidelity_of
from surrogym_server.environment.samples import Samples
from surrogym_server.environment.step_rules import placed, settle, with_lags
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import METADATA, from_bytes, to_bytes
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.sampling.design import advance
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.tensors import CPU
from surrogym_server.testing.cases import ModelCase, close
from surrogym_server.virtual import VirtualSettings, create, reset, step
from surrogym_shared.kinds import Variant

# A model passes as learned if its root mean square error is below this share of the standard deviation of the changes
# that it predicts.
GUESS = 0.5
RESERVED = "samples."
NONSENSE: tuple[Any, ...] = ("nonsense", [], None, math.inf)


def predictions_have_their_shapes_and_are_finite(case: ModelCase) -> None:
    m, outputs = len(case.points), len(case.definition.outputs)
    made = _everything(case.model, case)
    assert made.q_next.shape == case.points.q.shape
    assert made.reward.shape == (m,)
    assert made.std is not None
    assert made.reward_std is not None
    assert made.std.shape == (m, outputs - 1)
    assert made.reward_std.shape == (m,)
    assert case.model.means(case.points.q, case.points.u).shape == (m, outputs)
    for values in (made.q_next, made.reward, made.std, made.reward_std):
        assert values.dtype == torch.float64, "everything is float64"
        assert bool(torch.isfinite(values).all())
    assert float(made.std.min()) >= 0
    assert float(made.reward_std.min()) >= 0


def stds_are_given_where_they_are_asked_for(case: ModelCase) -> None:
    plain = case.model.transition(case.points.q, case.points.u)
    assert (plain.std, plain.reward_std) == (None, None)
    made = _everything(case.model, case)
    assert close(plain.q_next, made.q_next), "what is asked for beside it changes no prediction"
    assert close(plain.reward, made.reward)


def the_same_call_gives_the_same_numbers(case: ModelCase) -> None:
    before = _everything(case.model, case)
    case.model.transition(case.points.q + 1, case.points.u)
    assert _equal(before, _everything(case.model, case))


def learning_twice_gives_the_same_model(case: ModelCase) -> None:
    again = case.learner.learn(case.definition, case.samples).model
    assert _equal(_everything(again, case), _everything(case.model, case))
    assert (again.samples, again.digest) == (len(case.samples), case.samples.digest)


def points_do_not_see_those_beside_them(case: ModelCase) -> None:
    together = _everything(case.model, case)
    for index in range(5):
        alone = case.model.transition(case.points.q[index : index + 1], case.points.u[index : index + 1])
        assert close(alone.q_next[0], together.q_next[index])
        assert close(alone.reward[0], together.reward[index])


def without_points_there_are_no_steps(case: ModelCase) -> None:
    """Check that a prediction at no points has no rows and gives no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = case.model.transition(case.points.q[:0], case.points.u[:0], stds=True, reward_std=True)
    assert (made.std is not None, made.reward_std is not None) == (True, True)
    assert made.q_next.shape == (0, len(case.definition.coordinates))
    assert made.reward.shape == (0,)


def next_states_are_where_the_environment_can_be(case: ModelCase) -> None:
    fast = case.points.q.clone()
    fast[:, 1] = 5.9
    made = case.model.transition(fast, case.points.u, noise=10 * case.noise(len(fast), 2))
    assert torch.equal(made.q_next, settle(case.definition, made.q_next))


def a_draw_is_the_mean_and_noise_times_the_std(case: ModelCase) -> None:
    """Check that a sampled next speed is the mean plus noise times the standard deviation. The angle is not checked,
    because it follows the sampled speed."""
    q, u, noise = case.points.q, case.points.u, case.noise(len(case.points), 2)
    made = case.model.transition(q, u, noise=noise, stds=True)
    assert made.std is not None
    change = case.model.means(q, u)[:, :-1] + made.std * noise
    assert close(made.q_next[:, 1], settle(case.definition, q + placed(case.definition, change))[:, 1])


def lags_repeat_the_step(case: ModelCase) -> None:
    q, u = case.points.q, case.points.u
    q_next = case.model.transition(q, u).q_next
    assert torch.equal(q_next, with_lags(case.definition, q, u, q_next))


def it_learns(case: ModelCase) -> None:
    made, seen = case.model.transition(case.points.q, case.points.u), case.unseen
    off = made.q_next - seen.q_next
    off[:, 0] = torch.remainder(off[:, 0] + math.pi, 2 * math.pi) - math.pi
    moved = (seen.q_next - seen.q)[:, 1].std()
    assert float(off[:, 1].square().mean().sqrt()) < GUESS * float(moved)
    reward = made.reward + case.model.terminal_reward * case.model.terminated(made.q_next)
    assert float((reward - seen.reward).square().mean().sqrt()) < GUESS * float(seen.reward.std())


def scales_and_words_are_there_for_every_output(case: ModelCase) -> None:
    count = len(case.definition.outputs)
    assert case.model.scales.shape == (count,)
    assert float(case.model.scales.min()) > 0
    assert len(case.model.structures) == count
    assert all(isinstance(structure, str) and structure for structure in case.model.structures)
    described = json.loads(json.dumps(case.model.description, allow_nan=False))
    assert tuple(output["name"] for output in described["outputs"]) == case.definition.outputs


def what_is_declared_is_not_learned(case: ModelCase) -> None:
    made = _everything(case.model, case)
    if (known := case.definition.declared_reward) is not None:
        assert close(made.reward, known(case.points.q, case.points.u))
        assert made.reward_std is not None
        assert float(made.reward_std.max()) == 0
    if not case.definition.learns_termination:
        assert torch.equal(case.model.terminated(case.points.q), case.definition.terminated(case.points.q))


def ends_are_likely_where_they_were_seen(case: ModelCase) -> None:
    probability = case.model.termination_probability(case.unseen.q_next)
    assert probability.shape == (len(case.unseen),)
    assert 0 <= float(probability.min()) <= float(probability.max()) <= 1
    assert torch.equal(case.model.terminated(case.unseen.q_next), probability > 0.5)
    right = case.model.terminated(case.unseen.q_next) == case.unseen.terminated
    assert float(right.double().mean()) > 0.8


def an_end_that_was_never_seen_is_nowhere(case: ModelCase) -> None:
    if case.definition.learns_termination:
        none = Samples(*(getattr(case.samples, f.name)[~case.samples.terminated] for f in fields(Samples)))
        model = case.learner.learn(case.definition, none).model
        assert not bool(model.terminated(case.unseen.q_next).any())


def a_stored_model_predicts_the_same_bits(case: ModelCase) -> None:
    data = to_bytes(case.model)
    loaded = from_bytes(case.definition, data)
    assert _equal(_everything(loaded, case), _everything(case.model, case))
    assert torch.equal(loaded.termination_probability(case.points.q), case.model.termination_probability(case.points.q))
    assert (loaded.samples, loaded.digest) == (case.model.samples, case.model.digest)
    assert (loaded.description, loaded.structures) == (case.model.description, case.model.structures)
    assert to_bytes(loaded) == data


def stored_arrays_are_float64_and_keep_off_reserved_names(case: ModelCase) -> None:
    stored = case.learner.codec.encode(case.model)
    assert not {"family", "checksum"} & set(stored.header)
    assert not [name for name in stored.tensors if name.startswith(RESERVED)]
    assert {tensor.dtype for tensor in stored.tensors.values()} <= {torch.float64}


def a_damaged_file_is_refused_in_words(case: ModelCase) -> None:
    """Check that a damaged model file raises ``InvalidInput``. The checksum is removed from the file, so that the code
    of the model family that reads it has to detect the damage."""
    data = to_bytes(case.model)
    header = json.loads(json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"][METADATA])
    del header["checksum"]
    tensors, metadata = load(data), {METADATA: json.dumps(header)}
    for name, tensor in tensors.items():
        for other in (torch.full_like(tensor, math.nan), torch.cat([tensor.flatten(), tensor.flatten()[:1]])):
            _require_refused(case, save(tensors | {name: other}, metadata))
        _require_refused(case, save({n: t for n, t in tensors.items() if n != name}, metadata))
    for key in set(header) - {"family"}:
        for value in NONSENSE:
            _read_or_refused(case, save(tensors, {METADATA: json.dumps(header | {key: value})}))
    _require_refused(case, data[: len(data) // 2])


def a_warm_start_survives_storage_and_leads_to_a_model_as_good(case: ModelCase) -> None:
    stored = json.loads(json.dumps({name: array.tolist() for name, array in case.learned.warm.items()}))
    warm = {name: np.array(array) for name, array in stored.items()}
    model = case.learner.learn(case.definition, case.samples, warm).model
    off = model.transition(case.points.q, case.points.u).q_next[:, 1] - case.unseen.q_next[:, 1]
    assert float(off.square().mean().sqrt()) < GUESS * float((case.unseen.q_next - case.unseen.q)[:, 1].std())


def too_few_samples_are_refused(case: ModelCase) -> None:
    none = Samples(*(getattr(case.samples, field.name)[:0] for field in fields(Samples)))
    try:
        case.learner.learn(case.definition, none)
        said = ""
    except InvalidInput as error:
        said = str(error)
    assert "samples" in said, "expected InvalidInput for no samples at all, in a sentence that says so"


def a_model_stays_where_it_is_until_it_is_moved(case: ModelCase) -> None:
    assert case.model.on(CPU) is case.model


def every_variant_steps(case: ModelCase) -> None:
    variants: tuple[Variant, ...]
    variants = ("deterministic", "probabilistic", "pathwise")
    for variant in variants:
        settings = VirtualSettings(
            4, variant=variant, particles=8, penalty=1.0, autoreset_mode="same_step", time_limit=3
        )
        lanes, _ = reset(case.definition, settings, create(case.definition, settings, 0), 0)
        for _ in range(5):
            lanes, made = step(case.model, settings, lanes, np.ones((4, 1)), stds=True)
            assert np.isfinite(made.observation).all()
            assert np.isfinite(made.reward).all()


def a_round_of_the_design_asks_for_more(case: ModelCase) -> None:
    request = Request(budget=len(case.samples) + 6, target=1 - 1e-9, pending=case.points[:1].queries)
    decision = advance(case.definition, case.samples, DesignState(), request)
    assert decision.queries or decision.verdict == "ready"
    assert len(decision.confidences) == len(case.definition.outputs)
    json.dumps([decision.state.to_json(), fidelity_of(decision.model, (), 0.9)], allow_nan=False)


LAWS_OF_MODELS: tuple[Callable[[ModelCase], None], ...] = (
    predictions_have_their_shapes_and_are_finite,
    stds_are_given_where_they_are_asked_for,
    the_same_call_gives_the_same_numbers,
    learning_twice_gives_the_same_model,
    points_do_not_see_those_beside_them,
    without_points_there_are_no_steps,
    next_states_are_where_the_environment_can_be,
    a_draw_is_the_mean_and_noise_times_the_std,
    lags_repeat_the_step,
    it_learns,
    scales_and_words_are_there_for_every_output,
    what_is_declared_is_not_learned,
    ends_are_likely_where_they_were_seen,
    an_end_that_was_never_seen_is_nowhere,
    a_stored_model_predicts_the_same_bits,
    stored_arrays_are_float64_and_keep_off_reserved_names,
    a_damaged_file_is_refused_in_words,
    a_warm_start_survives_storage_and_leads_to_a_model_as_good,
    too_few_samples_are_refused,
    a_model_stays_where_it_is_until_it_is_moved,
    every_variant_steps,
    a_round_of_the_design_asks_for_more,
)


def _everything(model: DynamicsModel, case: ModelCase) -> Transition:
    return model.transition(case.points.q, case.points.u, stds=True, reward_std=True)


def _equal(one: Transition, other: Transition) -> bool:
    values: list[tuple[Tensor, Tensor]] = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Transition)]
    return all(torch.equal(*pair) for pair in values)


def _require_refused(case: ModelCase, data: bytes) -> None:
    assert not _read_or_refused(case, data), "expected InvalidInput for a file with a damaged array"


def _read_or_refused(case: ModelCase, data: bytes) -> bool:
    try:
        from_bytes(case.definition, data)
    except InvalidInput:
        return False
    return True
