"""The closed loop over a real server: queries between trainings, counted, and only while the design is unsure."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from support.models import learn
from support.real_steps import random_steps
from support.server import ServerProcess, running_server
from support.teaching import answer
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import Design, EnvironmentSpec
from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings, train
from surrogym_trainer.training.closed_loop import VISIT_LANES, ClosedLoop, LoopSettings, shares
from surrogym_trainer.training.search import search_for, with_algorithm
from surrogym_trainer.training.settings import DRAWS, chosen_for

SETTINGS = TrainSettings(
    "PPO", total_steps=400, num_envs=8, hyperparameters={"n_steps": 10, "batch_size": 40, "n_epochs": 1}
)
VISIT = 32 * 200  # 32 lanes for a time limit of 200


@pytest.fixture(scope="module")
def own_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server whose one process for fits is not busy with another test's surrogate."""
    with running_server(tmp_path_factory.mktemp("improve")) as server:
        yield server


@contextmanager
def sampling(url: str, name: str, spec: EnvironmentSpec) -> Iterator[None]:
    """A sampler in a thread."""
    over = threading.Event()

    def work() -> None:
        environment = GymnasiumEnvironment(spec)
        with Api(url) as api:
            while not over.is_set():
                queries = api.claim(name, "thread", max_queries=8, wait_seconds=0.2).queries
                if queries:
                    api.add_samples(name, "thread", [answer(environment, query) for query in queries])

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize(
    ("tolerance", "budget", "real_steps", "rounds"),
    [(1e-9, 4, 4 + 2 * 3, 2), (1e3, 4, 4, 1), (1e3, 8, 6, 0)],
    ids=["unsure", "known where it goes", "ready"],
)
def test_closed_loop_rounds_end_once_visited_states_are_certain_or_the_design_is_ready(
    own_server: ServerProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tolerance: float,
    budget: int,
    real_steps: int,
    rounds: int,
) -> None:
    """A budget of 4 leaves nothing for the queries that a design needs to be ready, however sure its model is."""
    asked: list[tuple[bool, bool | None]] = []

    def trained(port: SurrogatePort, out: Path, settings: TrainSettings, progress: Any) -> TrainResult:
        asked.append((settings.anew, settings.prolong))
        return train(port, out, replace(settings, prolong=False), progress)

    monkeypatch.setattr("surrogym_trainer.training.closed_loop.train", trained)
    settings = replace(SETTINGS, algorithm="FASTPPO", prolong=True)
    initial, unsure, ready = 4, tolerance < 1, budget > 4
    tolerances = dict.fromkeys(("theta", "speed", "reward"), tolerance)
    design = Design(initial=initial, budget=budget, target=0.9999999 if unsure else 0.501, monte_carlo=64)
    spec = pendulum().model_copy(update={"design": design, "tolerances": tolerances})
    name, seen = f"improve-{uuid4().hex[:8]}", []
    with Api(own_server.url) as api:
        api.create_surrogate(name, spec)
        with sampling(own_server.url, name, spec), HttpSurrogate(own_server.url, name) as port:
            wait_for_design(api, name, 60)
            improve = LoopSettings(queries=3, rounds=2, patience_seconds=60)
            loop = ClosedLoop(api, name, port, tmp_path / "p.zip", settings, improve, seen.append)
            result = loop.train()
        view = api.surrogate(name)
    assert view.ledger.total == real_steps
    assert loop.unspent == (0 if unsure else 2)
    assert view.ledger.initial == initial
    assert result.virtual_steps == 400 + rounds * VISIT, "the steps asked for are those of all trainings"
    assert result.path.exists()
    assert result.settings["session"] == ({} if ready else DRAWS), "only an unsure model is trained on by draws"
    assert asked == [(False, False)] * rounds + [(unsure, True)], (
        "a round is short, and a policy whose region is known is kept"
    )
    assert len(result.visited_confidence) == rounds
    assert [index >= design.target for index in result.visited_confidence] == (
        [False, False] if unsure else [True] * rounds
    )
    steps = [now.steps for now in seen]
    assert steps == sorted(steps)
    assert all(isinstance(now, TrainProgress) and now.steps <= now.total_steps for now in seen)


def test_training_keeps_a_session_variant_given_by_the_user_or_by_preset_paper(pendulum_server: ServerProcess) -> None:
    with Api(pendulum_server.url) as api:
        view = api.surrogate("pendulum")
    unsure = view.model_copy(update={"phase": "over_budget"})
    paper = unsure.model_copy(update={"spec": view.spec.model_copy(update={"design": Design(preset="paper")})})
    named = replace(SETTINGS, session={"variant": "deterministic", "penalty": 1.0})
    assert chosen_for(unsure, named) is named
    assert chosen_for(paper, SETTINGS) is SETTINGS
    assert chosen_for(view.model_copy(update={"phase": "ready"}), SETTINGS) is SETTINGS
    chosen = chosen_for(unsure, replace(SETTINGS, session={"penalty": 1.0, "particles": 2}))
    assert chosen.session == {**DRAWS, "penalty": 1.0, "particles": 2}
    assert chosen.judging == {"variant": "pathwise", "penalty": 1.0}, "particles are none of a function's"
    logged = unsure.model_copy(update={"spec": view.spec.model_copy(update={"outside_reward": -1.0})})
    of_a_log = chosen_for(logged, SETTINGS)
    assert (of_a_log.learning["start_box"], of_a_log.session) == (0.0, DRAWS), "no start where the log has not been"
    elsewhere = chosen_for(logged, replace(SETTINGS, start_box=0.2))
    assert elsewhere.learning["start_box"] == 0.2
    assert SETTINGS.judging == SETTINGS.session, "who learns by the mean is compared by it"


def test_state_dependent_exploration_is_reproducible_and_differs_between_environments(tmp_path: Path) -> None:
    out, spec = tmp_path / "policy.zip", pendulum()
    port = LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model)
    hyperparameters = {"n_steps": 16, "use_sde": True}
    settings = with_algorithm(TrainSettings(total_steps=128, num_envs=8, hyperparameters=hyperparameters), spec)
    train(port, out, settings)
    same = np.tile(np.float32([[1.0, 0.0, 0.5]]), (VISIT_LANES, 1))
    first, again = (search_for(settings).explorer(out, "PPO", VISIT_LANES) for _ in range(2))
    actions = np.asarray(first(same))
    assert len(np.unique(actions)) > VISIT_LANES / 2  # the rest are clipped to the bounds
    assert np.array_equal(actions, first(same)), "until the next visit"
    assert np.array_equal(actions, again(same))


def test_closed_loop_rounds_share_the_requested_virtual_steps() -> None:
    assert shares(TrainSettings(total_steps=1_750), rounds=3) == (1_750, 250), "the last has four rounds' steps"
    assert shares(TrainSettings(total_steps=1_900), rounds=9) == (1_900, 100), "many rounds leave it half and more"
    assert shares(TrainSettings("PPO"), rounds=3) == (1_000_000, 150_000)
