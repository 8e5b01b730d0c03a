"""Closed by default: what a server may be started with, and what it says to the rest."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.settings import Settings, read_settings

TOKEN = "a-long-token"


def test_the_default_server_listens_on_loopback_only():
    settings = read_settings({})
    assert (settings.host, settings.port, settings.tokens, settings.loopback) == ("127.0.0.1", 8000, {}, True)
    assert settings.database_url == "sqlite:///surrogym.db"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "robot.example"])
def test_listening_on_a_non_loopback_address_requires_a_token(host: str):
    with pytest.raises(InvalidInput, match=rf"^host {host} can be reached from other machines: expected a token"):
        read_settings({}, host=host)
    assert read_settings({"SURROGYM_TOKEN": TOKEN}, host=host).tokens == {TOKEN: "admin"}
    assert read_settings({}, host=host, insecure=True).host == host


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_listening_on_loopback_requires_no_token(host: str):
    assert read_settings({}, host=host).loopback


def test_settings_can_be_read_from_their_own_values():
    assert Settings.model_validate(Settings().model_dump()) == Settings()


def test_command_line_options_override_environment_variables():
    environment = {"SURROGYM_PORT": "9000", "SURROGYM_THREADS": "3"}
    settings = read_settings(environment, port=0, threads=None)
    assert (settings.port, settings.threads) == (0, 3)


def test_tokens_are_read_from_the_environment_with_their_roles(tmp_path: Path):
    file = tmp_path / "tokens"
    file.write_text("train:train-token\n\nplain-admin-token\n")
    environment = {"SURROGYM_TOKENS": "read:read-token,sample:sample-token"}
    assert read_settings(environment, token_file=file).tokens == {
        "read-token": "read",
        "sample-token": "sample",
        "train-token": "train",
        "plain-admin-token": "admin",
    }


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"SURROGYM_PORT": "many"}, "setting port: .*integer"),
        ({"SURROGYM_PORT": "70000"}, "setting port: .*65535"),
        ({"SURROGYM_TOKEN": "short"}, "at least 8 characters, got one of 5"),
        ({"SURROGYM_TOKENS": "king:some-long-token"}, "one of read, train, sample, admin before the colon"),
        ({"SURROGYM_TOKEN_FILE": "/no/such/file"}, "'/no/such/file' can't be read"),
        ({"SURROGYM_RAY_LEASE_SECONDS": "inf"}, "setting ray_lease_seconds: .*less than or equal to 3600"),
        ({"SURROGYM_RAY_LEASE_SECONDS": "0.5"}, "setting ray_lease_seconds: .*greater than or equal to 1"),
        (
            {"SURROGYM_RAY_CHECKPOINT_SECONDS": "1e-9"},
            "setting ray_checkpoint_seconds: .*greater than or equal to 0.01",
        ),
        ({"SURROGYM_RAY_CHECKPOINT_SECONDS": "inf"}, "setting ray_checkpoint_seconds: .*less than or equal to 3600"),
        ({"SURROGYM_DRIFT_WEBHOOK": "file:///etc/passwd"}, "setting drift_webhook: .*http:// or https://"),
        ({"SURROGYM_DRIFT_WEBHOOK": "https://name:word@host/x"}, "setting drift_webhook: .*without a user name"),
        ({"SURROGYM_LOG_LEVEL": "loud"}, "setting log_level: .*'info'"),
    ],
)
def test_the_error_for_an_invalid_server_setting_names_it(environment: dict[str, str], message: str):
    with pytest.raises(InvalidInput, match=message):
        read_settings(environment)


def test_the_error_for_an_invalid_token_does_not_print_it():
    with pytest.raises(InvalidInput) as refusal:
        read_settings({"SURROGYM_TOKEN": "secret", "SURROGYM_PORT": "-1"})
    assert "secret" not in str(refusal.value)


@pytest.mark.parametrize("token", ["geheimnis-ü", "a-secret\there", "a-secret\x7f"])
def test_a_token_that_no_header_can_contain_is_refused(token: str):
    with pytest.raises(InvalidInput, match="expected tokens of letters, digits and signs of ASCII") as refusal:
        read_settings({"SURROGYM_TOKEN": token})
    assert token not in str(refusal.value)


def test_the_error_for_a_token_containing_a_colon_does_not_print_it():
    with pytest.raises(InvalidInput) as refusal:
        read_settings({"SURROGYM_TOKENS": "secret-half:other-half"})
    assert "half" not in str(refusal.value)
