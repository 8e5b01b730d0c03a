"""A network of arrays: its layers, several at once, both kinds of action, and a file that holds no code."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec, MultiDiscreteAction

UNITS = 5


def network(spec: EnvironmentSpec, *many: int) -> Network:
    d = len(spec.observation)
    vector = np.random.default_rng(0).normal(size=(*many, Network.size(spec, UNITS)))
    return Network.of(spec, np.arange(d, dtype=float), np.full(d, 2.0), UNITS, vector)


def observations(spec: EnvironmentSpec, *shape: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(*shape, len(spec.observation))).astype(np.float32)


def test_continuous_actions_of_a_network_are_scaled_by_tanh():
    made, seen = network(pendulum()), observations(pendulum(), 7)
    x = (seen - [0, 1, 2]) / 2
    hidden, output = made.layers
    first = np.tanh(x @ hidden.weights + hidden.bias)
    np.testing.assert_allclose(made(seen), 2 * np.tanh(first @ output.weights + output.bias), rtol=1e-5)
    assert made(seen).shape == (7, 1)
    assert made(1e6 * seen).dtype == np.float32
    assert np.abs(made(1e6 * seen)).max() <= 2


@pytest.mark.parametrize(("counts", "shape"), [((3, 2), (50, 2)), ((4,), (50,))])
def test_discrete_actions_of_a_network_are_the_most_probable_ones(counts, shape):
    action = MultiDiscreteAction(nvec=counts)
    spec = cartpole().model_copy(update={"action": action})
    made, seen = network(spec), 10 * observations(spec, 50)
    chosen = made(seen)
    assert chosen.shape == shape
    hidden, output = made.layers
    scores = np.tanh((seen - made.mean) / 2 @ hidden.weights + hidden.bias) @ output.weights + output.bias
    expected = [part.argmax(1) for part in np.split(scores, np.cumsum(counts)[:-1], axis=1)]
    np.testing.assert_array_equal(chosen.reshape(50, -1), np.stack(expected, 1))
    assert len(np.unique(chosen)) > 1


def test_several_stacked_networks_give_the_actions_of_each_alone():
    many, seen = network(pendulum(), 3), observations(pendulum(), 3, 4)
    vector = np.random.default_rng(0).normal(size=(3, Network.size(pendulum(), UNITS)))
    for i in range(3):
        one = Network.of(pendulum(), many.mean, many.deviation, UNITS, vector[i])
        np.testing.assert_allclose(one(seen[i]), many(seen)[i], rtol=1e-6)
        np.testing.assert_allclose(one.vector, vector[i])


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_the_layers_of_a_network_are_applied_in_order(tmp_path: Path, activation):
    spec, units = pendulum(), (4, 6)
    vector = np.random.default_rng(0).normal(size=Network.size(spec, units))
    made = replace(Network.of(spec, np.zeros(3), np.ones(3), units, vector), activation=activation)
    assert [layer.weights.shape for layer in made.layers] == [(3, 4), (4, 6), (6, 1)]
    np.testing.assert_allclose(made.vector, vector)
    x = seen = observations(spec, 7).astype(float)
    for weights, bias in made.layers[:-1]:
        x = x @ weights + bias
        x = np.tanh(x) if activation == "tanh" else np.where(x > 0, x, 0)
    expected = 2 * np.tanh(x @ made.layers[-1].weights + made.layers[-1].bias)
    np.testing.assert_allclose(made(seen), expected, rtol=1e-6)
    made.save(tmp_path / "policy.zip")
    np.testing.assert_array_equal(Network.load(tmp_path / "policy.zip")(seen), made(seen))


def test_a_network_file_of_version_1_is_still_read(tmp_path: Path):
    made, seen = network(pendulum()), observations(pendulum(), 9)
    names = dict(zip(("hidden", "output"), made.layers, strict=True))
    arrays = {name: layer.weights for name, layer in names.items()}
    arrays |= {f"{name}_bias": layer.bias for name, layer in names.items()}
    arrays |= {name: getattr(made, name) for name in ("mean", "deviation", "low", "high")}
    with zipfile.ZipFile(tmp_path / "old.zip", "w") as file:
        file.writestr("surrogym-network.json", json.dumps({"version": 1, "counts": []}))
        with file.open("network.npz", "w") as opened:
            np.savez(opened, **arrays)
    np.testing.assert_array_equal(Network.load(tmp_path / "old.zip")(seen), made(seen))


def test_a_saved_network_is_read_back_unchanged(tmp_path: Path):
    path = tmp_path / "policy.zip"
    for spec in (pendulum(), cartpole()):
        network(spec).save(path)
        assert Network.is_at(path)
        np.testing.assert_array_equal(Network.load(path)(observations(spec, 9)), network(spec)(observations(spec, 9)))


@pytest.mark.parametrize("content", [b"", b"no zip", None])
def test_a_file_that_is_not_a_network_is_refused(tmp_path: Path, content):
    path = tmp_path / "policy.zip"
    if content is None:
        with path.open("wb") as file:
            np.savez(file, hidden=np.zeros(3))
    else:
        path.write_bytes(content)
    assert not Network.is_at(path)
    with pytest.raises(ValueError, match="not a policy of"):
        Network.load(path)


@pytest.mark.parametrize(
    ("name", "value"), [("mean", np.nan), ("low", -np.inf), ("deviation", 0.0), ("deviation", -1.0)]
)
def test_a_network_file_with_invalid_numbers_is_refused(tmp_path: Path, name, value):
    """Such a policy was loaded, and its actions were NaN."""
    made = network(pendulum())
    replace(made, **{name: np.full_like(getattr(made, name), value)}).save(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match=f"array {name}: expected finite numbers"):
        Network.load(tmp_path / "policy.zip")


def test_a_network_file_with_a_non_finite_weight_is_refused(tmp_path: Path):
    made = network(pendulum())
    made.layers[-1].weights[0] = np.inf
    made.save(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match="array weights1: expected finite numbers"):
        Network.load(tmp_path / "policy.zip")
