"""A stored model predicts the same bits, and bytes that are not one are refused."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from support.models import header_of
from surrogym_server.environment.features import FeatureMap
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes, with_checksum
from surrogym_server.models.gaussian_process.codec.model import FORMAT
from surrogym_server.models.gaussian_process.model import GaussianProcessModel


def rewritten(data: bytes, header: dict | None = None, **tensors: torch.Tensor | None) -> bytes:
    """The file with another header, and tensors replaced or (None) removed."""
    kept = load(data) | {name.replace("_", ".", 1): tensor for name, tensor in tensors.items()}
    return with_checksum(header or header_of(data), {n: t for n, t in kept.items() if t is not None})


@pytest.fixture(params=["pendulum_model", "cartpole_model"])
def model(request: pytest.FixtureRequest) -> GaussianProcessModel:
    return request.getfixturevalue(request.param)


@pytest.fixture
def data(pendulum_model: GaussianProcessModel) -> bytes:
    return to_bytes(pendulum_model)


def test_a_stored_model_predicts_bit_equal_after_loading(model):
    loaded = from_bytes(model.definition, to_bytes(model))
    generator = torch.manual_seed(1)
    q = torch.rand(50, len(model.definition.coordinates), generator=generator, dtype=torch.float64)
    u = torch.randint(0, 2, (50, 1), generator=generator).double()
    noise = torch.randn(50, len(model.transitions), generator=generator, dtype=torch.float64)
    for options in ({"stds": True}, {"noise": noise}, {"reward_std": True}, {}):
        ours, theirs = model.transition(q, u, **options), loaded.transition(q, u, **options)
        assert torch.equal(ours.q_next, theirs.q_next)
        assert torch.equal(ours.reward, theirs.reward)
        assert ours.std is None or torch.equal(ours.std, theirs.std)
        assert ours.reward_std is None or torch.equal(ours.reward_std, theirs.reward_std)


def test_a_model_file_with_a_flipped_bit_is_refused_or_loads_unchanged(model):
    data, refused = to_bytes(model), 0
    for place in np.random.default_rng(0).integers(len(data), size=300):
        flipped = bytearray(data)
        flipped[place] ^= 1 << int(place % 8)
        try:
            loaded = from_bytes(model.definition, bytes(flipped))
        except InvalidInput:
            refused += 1
        else:
            assert to_bytes(loaded) == data, "it was a byte that says nothing"
    assert refused > 250


def test_description_samples_and_digest_of_a_stored_model_survive_loading(model):
    loaded = from_bytes(model.definition, to_bytes(model))
    assert loaded.description == model.description
    assert (loaded.samples, loaded.digest, loaded.terminal_reward) == (
        model.samples,
        model.digest,
        model.terminal_reward,
    )
    assert to_bytes(loaded) == to_bytes(model)


@pytest.mark.parametrize("keep", [0, 7, 8, 100, -1])
def test_a_truncated_model_file_is_refused(pendulum_definition, data, keep):
    with pytest.raises(InvalidInput, match="safetensors"):
        from_bytes(pendulum_definition, data[:keep])


@pytest.mark.parametrize("place", [0, 7, 9, 200])
def test_a_model_file_with_a_changed_header_byte_is_refused(pendulum_definition, data, place):
    with pytest.raises(InvalidInput):
        from_bytes(pendulum_definition, data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])


def test_a_model_file_with_a_missing_tensor_is_refused(pendulum_definition, data):
    with pytest.raises(InvalidInput, match=r"'0\.weights'"):
        from_bytes(pendulum_definition, rewritten(data, **{"0_weights": None}))


def test_a_model_file_with_a_tensor_of_another_precision_is_refused(pendulum_definition, data):
    single = load(data)["0.x"].float()
    with pytest.raises(InvalidInput, match=r"expected x as torch\.float64"):
        from_bytes(pendulum_definition, rewritten(data, **{"0_x": single}))


@pytest.mark.parametrize("name", ["0_x", "0_y", "0_factor", "1_weights", "2_lengthscale"])
def test_a_model_file_with_a_tensor_of_another_shape_is_refused(pendulum_definition, data, name):
    with pytest.raises(InvalidInput, match="expected"):
        from_bytes(pendulum_definition, rewritten(data, **{name: torch.zeros(3, 2, dtype=torch.float64)}))


def test_a_model_file_without_a_required_header_field_is_refused(pendulum_definition, data):
    for field in ("outputs", "terminal_reward", "samples", "digest", "format"):
        header = {k: v for k, v in header_of(data).items() if k != field}
        with pytest.raises(InvalidInput):
            from_bytes(pendulum_definition, rewritten(data, header))


def test_a_model_file_of_another_format_or_environment_is_refused(pendulum_definition, cartpole_definition, data):
    for other in (FORMAT - 1, FORMAT + 1):
        with pytest.raises(InvalidInput, match=f"got format {other}, .* export its samples with that version"):
            from_bytes(pendulum_definition, rewritten(data, header_of(data) | {"format": other}))
    with pytest.raises(InvalidInput, match="outputs"):
        from_bytes(cartpole_definition, data)
    renamed = pendulum_definition.coordinates[0].model_copy(update={"name": "angle"})
    other = replace(pendulum_definition, coordinates=(renamed, pendulum_definition.coordinates[1]))
    with pytest.raises(InvalidInput, match="angle"):
        from_bytes(other, data)


def test_a_model_file_whose_transition_reads_the_next_state_is_refused(pendulum_definition, data):
    header = header_of(data)
    header["outputs"][1]["feature_map"] |= {"after": True}
    with pytest.raises(InvalidInput, match="after the step"):
        from_bytes(pendulum_definition, rewritten(data, header))


def test_a_safetensors_file_that_is_not_a_model_file_is_refused(pendulum_definition):
    for metadata in (None, {"surrogym": "not json"}, {"surrogym": "[]"}, {"other": "{}"}):
        with pytest.raises(InvalidInput):
            from_bytes(pendulum_definition, save({"a": torch.zeros(1)}, metadata))


def test_a_model_file_with_invalid_numbers_is_refused(pendulum_definition, pendulum_model):
    reward = pendulum_model.reward
    nowhere = replace(reward.posterior, weights=torch.full_like(reward.posterior.weights, math.nan))
    for bad in (
        replace(pendulum_model, terminal_reward=math.nan),
        replace(pendulum_model, samples=-5),
        replace(pendulum_model, reward=replace(reward, scale=0.0)),
        replace(pendulum_model, reward=replace(reward, posterior=nowhere)),
        replace(pendulum_model, reward=replace(reward, feature_map=FeatureMap(action="zzz"))),
        replace(
            pendulum_model,
            reward=replace(
                reward, posterior=replace(reward.posterior, hyper=replace(reward.posterior.hyper, signal_variance=-1.0))
            ),
        ),
    ):
        with pytest.raises(InvalidInput):
            from_bytes(pendulum_definition, to_bytes(bad))


def test_a_model_file_with_an_unterminated_header_is_refused(pendulum_definition):
    with pytest.raises(InvalidInput):
        from_bytes(pendulum_definition, (200_000).to_bytes(8, "little") + b"[" * 200_000)


def with_head(data: bytes, change) -> bytes:
    """The file with its safetensors header changed by a function of it."""
    length = int.from_bytes(data[:8], "little")
    head = json.loads(data[8 : 8 + length])
    change(head)
    text = json.dumps(head).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + length :]


def overlapping(head: dict) -> None:
    first, second = (entry for name, entry in list(head.items())[:3] if name != "__metadata__")
    second["data_offsets"] = first["data_offsets"]


def beyond_the_end(head: dict) -> None:
    entry = next(entry for name, entry in head.items() if name != "__metadata__")
    entry["data_offsets"], entry["shape"] = [0, 2**60], [2**57]


@pytest.mark.parametrize("change", [overlapping, beyond_the_end])
def test_a_model_file_with_overlapping_or_overlong_arrays_is_refused(pendulum_definition, data, change):
    with pytest.raises(InvalidInput, match="expected a model file of Surrogym"):
        from_bytes(pendulum_definition, with_head(data, change))


@pytest.mark.parametrize("length", [2**32, 2**63 - 1, 2**64 - 1])
def test_a_model_file_that_announces_a_huge_header_is_refused(pendulum_definition, data, length):
    with pytest.raises(InvalidInput, match="expected a model file of Surrogym"):
        from_bytes(pendulum_definition, length.to_bytes(8, "little") + data[8:])
