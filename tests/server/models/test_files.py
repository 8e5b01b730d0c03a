"""A model's file names its family, and is read by a surrogate of this family alone."""

import json
from dataclasses import replace

import pytest
from safetensors.torch import load, save

from support.exact_models import exact_pendulum
from support.models import header_of, learn, with_header
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes, with_checksum
from surrogym_server.models.port import DynamicsModel
from surrogym_server.plugins import Choice


@pytest.fixture(scope="module")
def model(pendulum_samples) -> DynamicsModel:
    return learn(exact_pendulum().definition, pendulum_samples).model


def test_a_model_file_names_its_model_family(model):
    assert header_of(to_bytes(model))["family"] == "gaussian_process"


def test_a_model_file_without_model_family_is_refused(model):
    header = header_of(to_bytes(model))
    del header["family"]
    with pytest.raises(InvalidInput, match="'family'"):
        from_bytes(model.definition, with_checksum(header, load(to_bytes(model))))


@pytest.mark.parametrize("checksum", [None, "", 7])
def test_a_model_file_without_checksum_is_refused(model, checksum):
    """It was not checked, so that another number in it was served."""
    data = to_bytes(model)
    header = header_of(data) | ({} if checksum is None else {"checksum": checksum})
    with pytest.raises(InvalidInput, match="checksum"):
        from_bytes(model.definition, save(load(data), {"surrogym": json.dumps(header)}))


FOREIGN = ("Header", "object", "deserializ", "Error", "int ", "Infinity", "NaN")  # words of libraries and of Python


def forgeries(data: bytes) -> dict[str, bytes]:
    """Files that are no models, by what is wrong with them."""
    header, tensors = header_of(data), load(data)
    return {
        "nothing": b"",
        "text": b"PK\x03\x04 not a model",
        "cut off": data[: len(data) // 2],
        "a header beyond the file": (2**63).to_bytes(8, "little") + data[8:],
        "a header that is a list": (2).to_bytes(8, "little") + b"[]",
        "deep nesting": (200_000).to_bytes(8, "little") + b"[" * 200_000,
        "no outputs": with_checksum(header | {"outputs": []}, tensors),
        "text for outputs": with_checksum(header | {"outputs": "abc"}, tensors),
        "a number for outputs": with_checksum(header | {"outputs": 3}, tensors),
        "no arrays": with_checksum(header, {}),
        "a huge number": with_checksum(header | {"samples": 10**400}, tensors),
        "a number that is none": with_checksum(header | {"samples": float("nan")}, tensors),
    }


def test_forged_model_files_are_refused_without_library_error_texts(model):
    """The messages were those of safetensors and of Python: HeaderTooLarge, 'int' object is not iterable."""
    for what, forged in forgeries(to_bytes(model)).items():
        with pytest.raises(InvalidInput, match=r"^expected") as refused:
            from_bytes(model.definition, forged)
        words = str(refused.value)
        assert not any(
            foreign in words for foreign in ("Header", "object", "deserializ", "Error", "int ", "Infinity")
        ), what
        assert len(words) < 300, what


@pytest.mark.parametrize("family", ["os", "ensemble", "", 7, None, "x" * 10_000])
def test_a_model_file_of_another_family_than_specified_is_refused(model, family):
    with pytest.raises(
        InvalidInput, match="family 'gaussian_process', as the specification says, got one of"
    ) as refused:
        from_bytes(model.definition, with_header(model, family=family))
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("family", ["sparse_gaussian_process", "bayesian_last_layer"])
def test_a_model_file_of_a_removed_family_is_refused_as_one_of_another_version(model, family):
    with pytest.raises(InvalidInput, match=rf"got one of the family '{family}', which another version wrote: export"):
        from_bytes(model.definition, with_header(model, family=family))


def test_the_model_family_is_taken_from_the_specification_and_not_the_file(model):
    """The specification names it, and the registry knows what is installed."""
    learning = replace(model.definition.learning, model=Choice("gaussian_process"))
    assert from_bytes(replace(model.definition, learning=learning), to_bytes(model)).samples == model.samples


def test_storing_a_model_of_another_family_as_gaussian_process_is_refused():
    with pytest.raises(TypeError, match="expected a model of Gaussian processes, got ExactModel"):
        to_bytes(exact_pendulum())
