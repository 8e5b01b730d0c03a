"""Episodes from a given state: the mean's is the stateless transition repeated; draws are keyed and bounded."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from surrogym_shared import wire

ACTIONS = [[1.5], [-0.5], [0.0]]


def imagine(client: httpx.Client, name: str, **body: Any) -> httpx.Response:
    return client.post(f"/v1/surrogates/{name}/imagine", json={"coordinates": [0.3, 0.1], "actions": ACTIONS, **body})


def test_an_imagined_mean_episode_equals_repeated_single_step_predictions(client: httpx.Client, taught: str):
    reply = wire.Imagined.model_validate_json(imagine(client, taught).raise_for_status().content)
    assert (len(reply.mean.coordinates), len(reply.mean.reward), reply.draws) == (4, 3, [])
    for step, action in enumerate(ACTIONS):
        body = {"coordinates": [reply.mean.coordinates[step]], "action": [action]}
        said = client.post(f"/v1/surrogates/{taught}/predict", json=body).json()
        assert reply.mean.coordinates[step + 1] == pytest.approx(said["next_coordinates"][0], abs=1e-9)
        assert reply.mean.reward[step] == pytest.approx(said["reward"][0], abs=1e-9)


def test_imagined_episodes_of_one_seed_are_the_same(client: httpx.Client, taught: str):
    first, again, other = (imagine(client, taught, draws=3, seed=seed).json() for seed in (1, 1, 2))
    assert first["draws"] == again["draws"] != other["draws"]
    ends = {tuple(episode["coordinates"][-1]) for episode in first["draws"]}
    assert (len(ends), {len(episode["coordinates"]) for episode in first["draws"]}) == (3, {4})


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({"actions": [[0.0]] * 501}, "500"),
        ({"draws": 65}, "64"),
        ({"coordinates": [0.1]}, "2"),
        ({"actions": [[9.0]]}, "9"),
        ({"actions": [[0.0, 0.0]]}, "expected shape (1, 1)"),
    ],
)
def test_a_request_to_imagine_an_invalid_episode_is_refused(
    client: httpx.Client, taught: str, body: dict[str, Any], says: str
):
    reply = imagine(client, taught, **body)
    assert reply.status_code == 422
    assert says in reply.text
