"""BARL, TIP and OPAX against the equations of their papers, with entropies from dense determinants in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from support.exact_models import ExactModel, exact_pendulum
from support.line import exact_line, line, taught
from support.models import gaussian_processes
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.errors import InvalidSpec
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.lookahead import process_inputs
from surrogym_server.models.port import DynamicsModel
from surrogym_server.plugins import Choice
from surrogym_server.sampling.acquisition import ACQUISITIONS, BARL, OPAX, TIP, Acquisition, acquisition_of
from surrogym_server.sampling.batch import candidate_view, choose
from surrogym_server.sampling.candidates import Candidates
from surrogym_server.sampling.confidence import deviations
from surrogym_server.sampling.design import DesignState, Request, advance
from surrogym_server.sampling.forecast import Forecast
from surrogym_server.sampling.optimal import optimal_trajectories
from surrogym_server.sampling.outlook import AfterSteps, outlook_of
from surrogym_server.sampling.rollouts import Aim, path_values, plan_rollout, plan_round, predict_paths, start_points
from surrogym_shared.spec import AcquisitionChoice, Design, EnvironmentSpec

TOLERANCES = (0.02, 0.1)  # of the line's step and reward
COUNT, HORIZON = 3, 6
Matrix = NDArray[np.float64]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def by(model: GaussianProcessModel, name: str, **settings: float) -> GaussianProcessModel:
    design = replace(model.definition.design, acquisition=Choice(name, tuple(settings.items())))
    return replace(model, definition=replace(model.definition, design=design))


@pytest.fixture(scope="module")
def learned() -> GaussianProcessModel:
    return gaussian_processes(definition_from_spec(line()), taught(30))


@pytest.fixture(scope="module")
def optimal(learned: GaussianProcessModel) -> tuple[PredictedSteps, ...]:
    return optimal_trajectories(learned, COUNT, HORIZON, rng())


@pytest.fixture(scope="module")
def places() -> Points:
    """A grid of candidates over the line, at three actions each."""
    q, u = torch.meshgrid(torch.linspace(-2.9, 2.9, 24), torch.tensor([-0.9, 0.1, 0.9]), indexing="ij")
    return Points(q.reshape(-1, 1).double(), u.reshape(-1, 1).double())


def values(
    model: DynamicsModel,
    acquisition: Acquisition,
    places: Points,
    optimal: Sequence[PredictedSteps],
    tolerances: Sequence[float] = TOLERANCES,
) -> torch.Tensor:
    nothing = places[:0]
    candidates = Candidates(places, torch.zeros(len(places)), places, torch.ones(len(places)).double())
    outlook = outlook_of(model, places, nothing, nothing)
    given = tuple(AfterSteps.of(model, steps).outlook(places, nothing) for steps in optimal)
    distance = torch.ones(len(places)).double()
    view = candidate_view(model, candidates, 0, outlook, tolerances, distance, given)
    return acquisition.value(view)


def covariance(model: GaussianProcessModel, column: int, parts: Sequence[PredictedSteps]) -> Matrix:
    """Posterior covariance of the points of all parts with each other, in the output's unit."""
    output = model.outputs[column]
    assert output.posterior is not None
    joined = PredictedSteps(*(torch.cat([getattr(part, name) for part in parts]) for name in ("q", "u", "q_next")))
    x = process_inputs(model.definition, output, joined)
    return output.scale**2 * output.posterior.joint_covariance(x[None])[0].numpy()


def entropy(cov: Matrix, noise: Matrix) -> float:
    """Of normal answers with this covariance and noise variances."""
    sign, log_det = np.linalg.slogdet(2 * np.pi * np.e * (cov + np.diag(noise)))
    assert sign > 0
    return 0.5 * float(log_det)


def gain(model: GaussianProcessModel, asked: PredictedSteps, optimal: Sequence[PredictedSteps]) -> float:
    """H[y | D] - E H[y | D, tau*] of the answers at all points that are asked, by H[y | t] = H[y, t] - H[t]."""
    total, size = 0.0, len(asked.q)
    for column, output in enumerate(model.outputs):
        assert output.posterior is not None
        own = output.scale**2 * (output.posterior.hyper.noise_variance + output.posterior.jitter)
        for way in optimal:
            joint = covariance(model, column, [asked, way])
            noise = np.array([TOLERANCES[column] ** 2] * size + [float(own)] * len(way.q))
            told = entropy(joint, noise) - entropy(joint[size:, size:], noise[size:])
            total += (entropy(joint[:size, :size], noise[:size]) - told) / len(optimal)
    return total


def steps_at(model: GaussianProcessModel, places: Points) -> PredictedSteps:
    return PredictedSteps(places.q, places.u, model.transition(places.q, places.u).q_next)


def test_barl_is_the_expected_drop_of_the_answers_entropy(learned, optimal, places):
    """Mehta et al. (ICLR 2022): EIG(x) = H[y | D] - E H[y | D, tau*], y with the tolerance as noise."""
    got = values(learned, BARL(), places, optimal)
    steps = steps_at(learned, places)
    at = range(0, len(places), 7)
    expected = [gain(learned, PredictedSteps(*(t[i : i + 1] for t in vars(steps).values())), optimal) for i in at]
    np.testing.assert_allclose(got[list(at)].numpy(), expected, rtol=1e-5, atol=1e-7)
    assert float(got.max()) > 0.05, "there is something to learn"
    torch.testing.assert_close(values(learned, TIP(), places, optimal), got)


def test_barl_asks_on_the_way_to_the_goal_and_variance_elsewhere(learned, places):
    """The optimal way is from 0 to 1. The largest deviation is far from the samples, at an end of the range. The reward
    has a tolerance at which it tells nothing: what is known of a parabola on the way is known of its ends."""
    way = optimal_trajectories(learned, 6, 12, rng(1))
    got = values(learned, BARL(), places, way, (0.02, 1e6))
    x = places.q[:, 0]
    assert -0.3 <= float(x[int(got.argmax())]) <= 1.5
    near, far = (x > -0.2) & (x < 1.2), x < -1.5
    assert float(got[near].mean()) > 3 * float(got[far].mean())
    spread = deviations(learned, places.q, places.u)[:, 0]
    assert not -0.3 <= float(x[int(spread.argmax())]) <= 1.5


def test_a_batch_counts_what_the_earlier_queries_tell(learned, optimal, places):
    """Choosing two at once is choosing one, and one more with the first taken as answered."""
    model = by(learned, "barl", trajectories=COUNT, horizon=HORIZON)
    candidates = Candidates(places, torch.zeros(len(places)), places, torch.ones(len(places)).double())
    nothing = places[:0]
    batch = choose(model, candidates, nothing, nothing, [0, 0], TOLERANCES, optimal=optimal)
    first = choose(model, candidates, nothing, nothing, [0], TOLERANCES, optimal=optimal)
    second = choose(model, candidates, places[first], places[first], [0], TOLERANCES, optimal=optimal)
    assert batch == first + second
    assert len(set(batch)) == 2


@pytest.fixture(scope="module")
def path(learned: GaussianProcessModel):
    actions = torch.tensor([[0.9], [0.9], [-0.4], [0.7], [0.2]]).double()
    paths = predict_paths(learned, torch.zeros(1, 1).double(), actions[None])
    return replace(paths, drift=torch.zeros_like(paths.drift))


AIM = Aim((0, 1), TOLERANCES, longest=5)


def test_tip_is_the_joint_drop_of_all_answers_on_the_path(learned, optimal, path):
    """Mehta et al. (NeurIPS 2022): C = H[y_1..y_t | D] - E H[y_1..y_t | D, tau*], at every t."""
    model = by(learned, "tip")
    got = path_values(model, AIM, path, [AfterSteps.of(model, way) for way in optimal])[0]
    for t in range(1, 6):
        asked = PredictedSteps(path.q[0, :t], path.u[0, :t], path.q_next[0, :t])
        assert float(got[t - 1]) == pytest.approx(gain(learned, asked, optimal), rel=1e-4, abs=1e-6), t


def test_barl_sums_along_a_path_as_if_each_step_were_the_only_one(learned, optimal, path):
    model = by(learned, "barl")
    got = path_values(model, AIM, path, [AfterSteps.of(model, way) for way in optimal])[0]
    steps = PredictedSteps(path.q[0], path.u[0], path.q_next[0])
    each = [gain(learned, PredictedSteps(*(t[i : i + 1] for t in vars(steps).values())), optimal) for i in range(5)]
    np.testing.assert_allclose(got.numpy(), np.cumsum(each), rtol=1e-4, atol=1e-6)
    jointly = path_values(by(learned, "tip"), AIM, path, [AfterSteps.of(model, way) for way in optimal])[0]
    assert float(jointly[-1]) < float(got[-1]), "neighbours tell the same twice"


def test_opax_sums_logarithms_over_outputs_and_steps(learned, places, path):
    """Sukhija et al. (NeurIPS 2023): sum_t sum_j log(1 + sigma_j^2 / noise_j^2), step by step."""
    sigma = deviations(learned, places.q, places.u).numpy()
    expected = [sum(np.log(1 + (s / t) ** 2) for s, t in zip(row, TOLERANCES, strict=True)) for row in sigma]
    np.testing.assert_allclose(values(learned, OPAX(), places, ()).numpy(), expected, rtol=1e-6)
    got = path_values(by(learned, "opax"), AIM, path)[0]
    total, sums = 0.0, []
    for t in range(5):
        for j, output in enumerate(learned.outputs):
            step = PredictedSteps(path.q[0, t : t + 1], path.u[0, t : t + 1], path.q_next[0, t : t + 1])
            spread = output.mean_and_deviation(process_inputs(learned.definition, output, step))[1]
            total += np.log(1 + (float(spread[0]) / TOLERANCES[j]) ** 2)
        sums.append(total)
    np.testing.assert_allclose(got.numpy(), sums, rtol=1e-6)


def test_an_optimistic_path_misses_the_mean_by_its_controls(learned):
    """x' = mean + optimism * sigma * eta, and the path does not drift."""
    forecast = Forecast.of(learned, OPAX(optimism=1.5), (), rng())
    assert forecast.controls == 1
    controls = torch.tensor([[[0.5, 1.0], [-0.5, -0.25], [1.0, 0.0]]]).double()
    paths = predict_paths(learned, torch.zeros(1, 1).double(), controls, forecast.move(learned, 1, 1))
    q = torch.zeros(1, 1).double()
    for t in range(3):
        torch.testing.assert_close(paths.q[:, t], q)
        step = learned.transition(q, controls[:, t, :1], deviations=True)
        q = step.q_next + 1.5 * step.deviation * controls[:, t, 1:]
    torch.testing.assert_close(paths.q_next[:, 2], q)
    torch.testing.assert_close(paths.u, controls[..., :1])
    assert not paths.drift.any()


def test_an_optimistic_plan_believes_in_luck():
    """A line whose actions do nothing, less certain the farther right: only luck leads there. The plan has actions
    alone, and is worth what luck promises."""

    def stay(q: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return q + 0 * u

    still = ExactModel(exact_line().definition, stay, lambda q, _: q[:, 0], 0.4, lambda q: q[:, 0].clamp_min(0))
    aim = Aim((1,), TOLERANCES, longest=5)
    found = []
    for optimism in (0.01, 1.0):
        design = replace(still.definition.design, acquisition=Choice("opax", (("optimism", optimism),)))
        model = replace(still, definition=replace(still.definition, design=design))
        assert plan_rollout(model, aim, rng()).actions.shape[1] == 1
        forecast = Forecast.of(model, acquisition_of(design.acquisition), (), rng())
        eager = torch.ones(1, 5, 2).double()
        paths = predict_paths(model, torch.zeros(1, 1).double(), eager, forecast.move(model, 1, 1))
        found.append(float(path_values(model, aim, paths)[0, -1]))
    assert found[1] > 10 * found[0]


def test_the_known_optimal_trajectory_is_found():
    """Full speed from 0 to 1, then rest: five steps of 0.2, and hardly any reward is lost by what is found."""
    (way,) = optimal_trajectories(exact_line(), 1, 12, rng())
    assert len(way.q) == 12, "the time limit"
    best = -sum((1 - 0.2 * t) ** 2 for t in range(1, 6))
    got = -(way.q_next[:, 0] - 1).square().sum()
    assert float(got) > best - 0.15
    assert bool((way.u[:3] > 0.8).all())
    torch.testing.assert_close(way.q[1:], way.q_next[:-1])


def test_optimal_trajectories_are_those_of_different_functions(learned, optimal):
    assert [len(way.q) for way in optimal] == [HORIZON] * COUNT
    assert not torch.equal(optimal[0].q, optimal[1].q)
    again = optimal_trajectories(learned, COUNT, HORIZON, rng())
    assert all(torch.equal(a.q_next, b.q_next) for a, b in zip(optimal, again, strict=True))
    for way in optimal:
        mean, spread = learned.transition(way.q, way.u, deviations=True), 0.0
        assert mean.deviation is not None
        spread = float(((way.q_next - mean.q_next) / (mean.deviation + 1e-3)).abs().max())
        assert 0 < spread < 6, "near the mean, but not on it"


def test_an_optimal_trajectory_ends_with_the_episode():
    model = exact_pendulum()
    model = replace(model, definition=replace(model.definition, time_limit=4))
    assert [len(way.q) for way in optimal_trajectories(model, 2, 50, rng())] == [4, 4]


def test_each_lane_of_a_plan_follows_a_function_of_its_own(learned, optimal):
    forecast = Forecast.of(learned, TIP(trajectories=COUNT, horizon=HORIZON), optimal, rng())
    starts = forecast.lanes(torch.zeros(2, 1, 1).double())
    assert starts.shape == (2, COUNT, 1), "a start for each function"
    assert forecast.lanes(torch.zeros(2, 5, 1).double()).shape == (2, 5, 1)
    actions = torch.full((2 * COUNT, 3, 1), 0.5).double()
    ends = predict_paths(learned, starts.flatten(0, 1), actions, forecast.move(learned, 2, COUNT)).q_next[:, -1, 0]
    torch.testing.assert_close(ends[:COUNT], ends[COUNT:])
    assert len(set(ends[:COUNT].tolist())) == COUNT


def test_a_family_without_lookahead_is_told_by_distance():
    """A trajectory then removes what is uncertain near its steps, for candidates and for paths."""
    model = exact_line(deviation=0.5)
    way = PredictedSteps(*(torch.zeros(1, 1).double() for _ in range(3)))
    places = Points(torch.tensor([[0.0], [2.9]]).double(), torch.zeros(2, 1).double())
    near, far = values(model, BARL(), places, [way]).tolist()
    assert near == pytest.approx(0.5 * np.log(1 + (0.5 / 0.02) ** 2), rel=1e-6)
    assert far < 0.1 * near
    design = replace(model.definition.design, acquisition=Choice("tip"))
    tip = replace(model, definition=replace(model.definition, design=design))
    stays = torch.zeros(1, 2, 1).double()
    paths = [predict_paths(tip, start.reshape(1, 1).double(), stays) for start in torch.tensor([0.0, 2.9])]
    here, there = (float(path_values(tip, AIM, path, [AfterSteps.of(tip, way)])[0, -1]) for path in paths)
    assert here > 3 * there


@pytest.mark.parametrize("name", ACQUISITIONS.names)
def test_every_acquisition_keeps_the_laws(learned, optimal, places, path, name):
    """Pure, one finite value for each candidate and beginning of a path, no decrease along a path."""
    model, kept = by(learned, name), places.q.clone()
    acquisition = acquisition_of(Choice(name))
    first, again = (
        values(model, acquisition, places, optimal) if acquisition.trajectories else plain(model, acquisition, places)
        for _ in range(2)
    )
    assert first.shape == (len(places),)
    assert bool(first.isfinite().all())
    assert torch.equal(first, again)
    assert torch.equal(places.q, kept)
    after = [AfterSteps.of(model, way) for way in optimal] if acquisition.trajectories else []
    along = path_values(model, AIM, path, after)
    assert along.shape == (1, 5)
    assert bool(along.isfinite().all())
    assert bool((along.diff(dim=1) >= -1e-9).all())


def plain(model: GaussianProcessModel, acquisition: Acquisition, places: Points) -> torch.Tensor:
    candidates = Candidates(places, torch.zeros(len(places)), places, torch.ones(len(places)).double())
    outlook = outlook_of(model, places, places, places[:0])
    view = candidate_view(model, candidates, 0, outlook, [*TOLERANCES], torch.ones(len(places)).double())
    return acquisition.value(view)


@pytest.mark.parametrize("name", ["barl", "tip", "opax"])
def test_rollouts_are_planned(learned, optimal, name):
    """From resets and from snapshots, with as many steps as asked, and again the same."""
    settings = {} if name == "opax" else {"trajectories": COUNT, "horizon": HORIZON}
    model = by(learned, name, **settings)
    aim = replace(AIM, optimal=() if name == "opax" else optimal, snapshots=torch.tensor([[0.5], [-1.0]]).double())
    for aimed in (aim, replace(aim, snapshots=None)):
        first, again = (plan_round(model, aimed, 3, (), rng()) for _ in range(2))
        assert sum(map(len, first)) == 3
        assert all(one.actions.shape[1] == 1 and bool((one.actions.abs() <= 1).all()) for one in first)
        assert all(torch.equal(a.actions, b.actions) for a, b in zip(first, again, strict=True))


@pytest.mark.parametrize("name", ["barl", "tip", "opax"])
@pytest.mark.parametrize("resets", [False, True])
def test_a_round_of_a_design_asks_by_them(name, resets):
    """The design draws the trajectories, by its own seed: the same round again asks the same."""
    settings = {} if name == "opax" else {"trajectories": 2, "horizon": 4}
    chosen = Design(acquisition=AcquisitionChoice(name=name, settings=settings), symmetry="none", initial=4)
    changes = {"design": chosen.model_dump(), **({"query": "rollout", "max_rollout": 6} if resets else {})}
    definition = definition_from_spec(EnvironmentSpec.model_validate(line().model_dump() | changes))
    samples = taught(8)
    request = Request(40, 0.999, Points(samples.q[:0], samples.u[:0]))
    first, again = (advance(definition, samples, DesignState(), request) for _ in range(2))
    assert first.verdict == "continue"
    assert (len(first.q) > 0) is not resets
    assert (len(first.rollouts) > 0) is resets
    assert torch.equal(first.q, again.q)
    for one, other in zip(first.rollouts, again.rollouts, strict=True):
        assert torch.equal(one.actions, other.actions)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("barl", {"trajectories": 0}, "expected trajectories between 1 and 100, got 0"),
        ("barl", {"trajectories": 101}, "expected trajectories between 1 and 100, got 101"),
        ("tip", {"horizon": 0}, "expected horizon between 1 and 1000, got 0"),
        ("tip", {"horizon": 2.5}, "expected horizon to be a whole number, got 2.5"),
        ("opax", {"optimism": 0.0}, "expected a positive optimism, got 0.0"),
        ("opax", {"optimism": float("nan")}, "expected a positive optimism, got nan"),
        ("opax", {"trajectories": 3}, "expected a setting out of optimism, got 'trajectories'"),
    ],
)
def test_wrong_settings_are_refused(name, settings, said):
    with pytest.raises(InvalidSpec, match=said):
        acquisition_of(Choice(name, tuple(settings.items())))


def test_starts_of_optimal_trajectories_are_the_declared_ones(learned, optimal):
    assert all(abs(float(way.q[0, 0])) <= 0.01 for way in optimal)
    assert start_points(learned.definition, 1, rng()).shape == (1, 1)
