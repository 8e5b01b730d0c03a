"""A model's file names its family, and is read by a surrogate of this family alone."""

import json
from dataclasses import replace

import pytest
from safetensors.torch import load, save

from support.exact_models import exact_pendulum
from support.models import learn
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.port import DynamicsModel
from surrogym_server.plugins import Choice


@pytest.fixture(scope="module")
def model(pendulum_samples) -> DynamicsModel:
    return learn(exact_pendulum().definition, pendulum_samples).model


def header_of(data: bytes) -> dict:
    metadata = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    return json.loads(metadata["surrogym"])


def rewritten(data: bytes, header: dict) -> bytes:
    return save(load(data), {"surrogym": json.dumps(header)})


def test_a_file_names_its_family(model):
    assert header_of(to_bytes(model))["family"] == "gaussian_process"


def test_a_file_without_a_family_is_refused(model):
    header = header_of(to_bytes(model))
    del header["family"], header["checksum"]
    with pytest.raises(InvalidInput, match="'family'"):
        from_bytes(model.definition, rewritten(to_bytes(model), header))


@pytest.mark.parametrize("family", ["os", "ensemble", "", 7, None, "x" * 10_000])
def test_a_file_of_another_family_than_the_specifications_is_refused(model, family):
    header = header_of(to_bytes(model)) | {"family": family}
    del header["checksum"]
    with pytest.raises(
        InvalidInput, match="family 'gaussian_process', as the specification says, got one of"
    ) as refused:
        from_bytes(model.definition, rewritten(to_bytes(model), header))
    assert len(str(refused.value)) < 300


def test_a_family_is_not_looked_up_because_a_file_names_it(model):
    """The specification names it, and the registry knows what is installed."""
    learning = replace(model.definition.learning, model=Choice("gaussian_process"))
    assert from_bytes(replace(model.definition, learning=learning), to_bytes(model)).samples == model.samples


def test_a_model_of_another_family_is_not_stored_under_this_one():
    with pytest.raises(TypeError, match="expected a model of Gaussian processes, got ExactModel"):
        to_bytes(exact_pendulum())
