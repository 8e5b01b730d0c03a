"""A token of this user is sent to a Ray cluster, unless the user has decided otherwise."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from surrogym_shared.ray_address import AUTH_MODE, TOKEN, TOKEN_PATH, send_token


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A home folder without a token, and no variable of Ray."""
    for name in (AUTH_MODE, TOKEN, TOKEN_PATH):
        monkeypatch.setenv(name, "")  # so that it is restored afterwards
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def mode() -> str | None:
    send_token()
    return os.environ.get(AUTH_MODE)


def test_without_a_ray_token_the_authentication_mode_is_left_unset():
    assert mode() is None


@pytest.mark.parametrize("place", ["home", "path", "variable"])
def test_a_ray_token_in_any_location_enables_token_authentication(
    monkeypatch: pytest.MonkeyPatch, home: Path, place: str
):
    file = home / (".ray/auth_token" if place == "home" else "token")
    file.parent.mkdir(exist_ok=True)
    if place == "variable":
        monkeypatch.setenv(TOKEN, "secret")
    else:
        file.write_text("secret")
    if place == "path":
        monkeypatch.setenv(TOKEN_PATH, str(file))
    assert mode() == "token"


def test_a_ray_authentication_mode_set_by_the_user_is_kept(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(TOKEN, "secret")
    monkeypatch.setenv(AUTH_MODE, "disabled")
    assert mode() == "disabled"
