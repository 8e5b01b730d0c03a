"""Virtual states are shown by the original environment's renderer, and RecordVideo films them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import imageio.v2 as imageio
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from support.exact_pendulum import ExactPendulum
from surrogym_client.environments import RemoteEnv, RemoteVectorEnv
from surrogym_client.environments.env import drawn
from surrogym_client.environments.pictures import NotRenderable, Pictures, coordinates_from_observation
from surrogym_client.registration import SWING_UP
from surrogym_sampler.original.classic import TASKS
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.mujoco_tasks import SPECIFICATIONS
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform
from surrogym_shared.terms import observe

SPECS = {name: task.spec() for name, task in TASKS.items()} | {name: make() for name, make in SPECIFICATIONS.items()}
SHOWN = (
    SWING_UP,
    "Pendulum-v1",
    "CartPole-v1",
    "Acrobot-v1",
    "MountainCarContinuous-v0",
    "Reacher-v5",
    "InvertedPendulum-v5",
)
LINE = EnvironmentSpec(
    environment="line:Line",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="far", term=Term.linear(x=2) + Term.constant(1)),),
    action=BoxAction(low=(-1,), high=(1,)),
    start={"x": Uniform(low=-1, high=1)},
)
BLIND = LINE.model_copy(update={"observation": (ObservationEntry(name="s", term=Term.sin(x=1)),)})
OWN = """
import numpy as np

class Line:
    frames_per_second = 5

    def picture(self, coordinates):
        frame = np.zeros((4, 20, 3), dtype=np.uint8)
        frame[:, int(10 + 9 * coordinates[0])] = 255
        return frame

class Blind:
    pass
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "line.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "line", raising=False)


@pytest.mark.parametrize("name", SPECS)
def test_the_state_can_be_recovered_from_every_built_in_observation(name: str) -> None:
    spec, rng = SPECS[name], np.random.default_rng(0)
    read = coordinates_from_observation(spec)
    for _ in range(20):
        coordinates = draw(spec, rng, wide=True)
        np.testing.assert_allclose(read(observe(spec, coordinates[None])[0]), coordinates, atol=1e-12)


DRAW = "import gymnasium; e = gymnasium.make('InvertedPendulum-v5', render_mode='rgb_array'); e.reset(); e.render()"


@pytest.fixture(scope="module")
def mujoco_draws() -> bool:
    """Whether MuJoCo finds a graphics library, tried in a process of its own, for it may crash where there is none."""
    return subprocess.run([sys.executable, "-c", DRAW], capture_output=True).returncode == 0


@pytest.mark.parametrize("name", SHOWN)
def test_a_rendered_virtual_state_equals_the_original_environments_picture(name: str, mujoco_draws: bool) -> None:
    if name in SPECIFICATIONS and not mujoco_draws:
        pytest.skip("MuJoCo can't draw here: it needs a display, or libegl1 with MUJOCO_GL=egl")
    env = gymnasium.make(name, render_mode="rgb_array")
    pictures = Pictures(SPECS[name])
    frames = []
    for seed in (1, 2):
        observation, _ = env.reset(seed=seed)
        frames.append(pictures.of(observation))
        off = np.abs(frames[-1].astype(int) - env.render())
        assert off.mean() < 0.5, "but for the rounding of observations"
    assert (frames[0] != frames[1]).any()
    assert pictures.frames_per_second == env.metadata["render_fps"]
    pictures.close()
    env.close()


def test_gymnasiums_record_video_films_a_virtual_episode(tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    virtual = RemoteEnv(ExactPendulum(), render_mode="rgb_array", time_limit=8)
    with RecordVideo(virtual, str(videos), disable_logger=True) as env:
        env.reset(seed=0)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(np.zeros(1, dtype=np.float32))
            over = terminated or truncated
    (video,) = videos.glob("*.mp4")
    with imageio.get_reader(video) as film:
        assert film.count_frames() == 9
        assert film.get_data(0).std() > 5


def test_rendering_a_vector_environment_returns_one_picture_per_environment() -> None:
    envs = RemoteVectorEnv(ExactPendulum(), 2, render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 2
    assert (frames[0] != frames[1]).any()
    envs.step(np.zeros((2, 1), dtype=np.float32))
    assert (envs.render()[0] != frames[0]).any()
    envs.close()
    assert RemoteVectorEnv(ExactPendulum(), 2).render() is None


def test_virtual_states_are_rendered_by_a_user_defined_environment_class(own: None) -> None:
    pictures = Pictures(LINE, "line:Line")
    assert pictures.of(np.array([2.0]))[0, 14].tolist() == [255] * 3  # far = 2 x + 1, so x = 0.5
    assert pictures.frames_per_second == 5


@pytest.mark.parametrize(
    ("spec", "original", "message"),
    [
        (LINE, None, r"expected original='package\.module:factory'"),
        (LINE, "line:Blind", r"have a method picture\(coordinates\), got a Blind"),
        (BLIND, "line:Line", "got none for 'x'"),
    ],
)
def test_a_render_mode_that_cannot_work_is_refused_with_a_reason(own: None, spec, original, message) -> None:
    with pytest.raises(NotRenderable, match=message):
        Pictures(spec, original)


def test_the_error_for_a_missing_renderer_package_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = RemoteEnv(ExactPendulum(), render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(NotRenderable, match=r"Pendulum-v1 can't be shown here: .*surrogym\[render\]"):
        env.render()


@pytest.mark.parametrize("kind", [RemoteEnv, RemoteVectorEnv])
def test_a_render_mode_is_declared_only_where_its_renderer_is_installed(kind, monkeypatch: pytest.MonkeyPatch) -> None:
    assert kind(ExactPendulum()).metadata["render_modes"] == ["rgb_array"]
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert kind(ExactPendulum()).metadata["render_modes"] == []


@pytest.mark.parametrize(
    ("spec", "original", "modes"),
    [
        (SPECS[SWING_UP], None, ["rgb_array"]),
        (SPECS["Reacher-v5"], None, []),
        (LINE, None, []),
        (LINE, "line:Line", ["rgb_array"]),
        (LINE, SWING_UP, ["rgb_array"]),
        (BLIND, "line:Line", []),
    ],
)
def test_the_declared_render_modes_are_those_that_can_be_drawn(
    spec, original, modes, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("pygame", "mujoco"):
        monkeypatch.setitem(sys.modules, module, None)
    assert drawn(spec, original, None) == (None, {"render_modes": modes})


def test_rendering_before_the_first_reset_is_refused() -> None:
    for env in (
        RemoteEnv(ExactPendulum(), render_mode="rgb_array"),
        RemoteVectorEnv(ExactPendulum(), 2, render_mode="rgb_array"),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"expected a call of reset\(\) before render\(\)"):
            env.render()


def test_a_refused_render_mode_opens_no_session() -> None:
    for kind in (RemoteEnv, RemoteVectorEnv):
        with pytest.raises(ValueError, match="expected render_mode None or rgb_array for a surrogate, got 'human'"):
            kind(port := ExactPendulum(), render_mode="human")
        assert port.opened == []
