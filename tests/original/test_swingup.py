"""The swing-up has the physics and the rewards that it says it has."""

import gymnasium
import numpy as np
import pytest

from surrogym_sampler.original.swingup import GRAVITY, CartPoleSwingUp

HANGING, UPRIGHT = np.zeros(4), np.array([0, 0, np.pi, 0])


def energy(env):
    """Kinetic and potential energy of the cart and of a uniform rod."""
    _, v, angle, omega = env.state
    m, length = env.masspole, env.length
    kinetic = (env.masscart + m) * v**2 / 2 + m * length * (v * omega * np.cos(angle) + length * omega**2 / 3) / 2
    return kinetic - m * GRAVITY * length * np.cos(angle) / 2


def test_the_swing_up_conserves_energy_without_friction_and_force():
    env = CartPoleSwingUp()
    env.friction = 0.0
    env.state = np.array([0.3, -1.0, 2.0, 3.0])
    before = energy(env)
    for _ in range(40):
        env.step(np.zeros(1))
    assert energy(env) == pytest.approx(before, abs=1e-4)


def test_the_energy_gain_of_the_swing_up_equals_the_work_of_the_force():
    env = CartPoleSwingUp()
    env.friction = 0.0
    env.state = np.array([0.0, 0.5, 1.0, -2.0])
    before, x = energy(env), env.state[0]
    for _ in range(10):
        env.step(np.array([7.0]))
    assert energy(env) - before == pytest.approx(7.0 * (env.state[0] - x), abs=1e-3)


@pytest.mark.parametrize(("kind", "width"), [("smooth", 0.6), ("narrow", 0.25)])
def test_the_swing_up_reward_depends_on_the_tips_distance_after_the_step(kind, width):
    env = CartPoleSwingUp(kind)
    for state in (HANGING, UPRIGHT, np.array([0.4, 1.0, 2.5, -3.0])):
        env.state = state.copy()
        _, reward, terminated, _, _ = env.step(np.zeros(1))
        tip = np.array([env.state[0] + 0.6 * np.sin(env.state[2]), -0.6 * np.cos(env.state[2])])
        assert reward == pytest.approx(np.exp(-np.sum((tip - [0, 0.6]) ** 2) / (2 * width**2)))
        assert not terminated


def test_the_narrow_swing_up_pays_1_upright_and_nearly_0_hanging():
    env = CartPoleSwingUp("narrow")
    env.state = UPRIGHT.copy()
    assert env.step(np.zeros(1))[1] == pytest.approx(1.0)
    env.state = HANGING.copy()
    assert env.step(np.zeros(1))[1] < 1e-4


def test_gymnasium_make_creates_both_swing_up_variants():
    assert gymnasium.make("surrogym/CartPoleSwingUp-v0").unwrapped.width == 0.6
    assert gymnasium.make("surrogym/CartPoleSwingUpNarrow-v0").unwrapped.width == 0.25
    with pytest.raises(ValueError, match="expected one of smooth, narrow, got 'steep'"):
        CartPoleSwingUp("steep")


def test_the_swing_up_picture_shows_pole_and_goal_at_the_right_pixels():
    env = CartPoleSwingUp(render_mode="rgb_array")
    env.state = np.array([0.5, 0, np.pi / 2, 0])  # level, from half a metre to the right of the middle
    frame = env.render()
    assert (frame.shape, frame.dtype) == ((300, 600, 3), np.uint8)
    pole, goal = [202, 152, 101], [240, 190, 180]
    assert frame[150, 300 + 120].tolist() == frame[150, 300 + 60].tolist() == pole
    assert frame[150 - 72, 300].tolist() == goal
    env.state = UPRIGHT.copy()
    assert env.render()[150 - 72, 300].tolist() == pole
    assert CartPoleSwingUp().render() is None
