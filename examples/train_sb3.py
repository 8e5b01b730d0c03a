"""Stable-Baselines3 against a surrogate: any of its algorithms takes the vector environment.

python train_sb3.py pendulum --steps 100000

Progress goes to TensorBoard under runs/sb3; `surrogym evaluate sb3.zip --env Pendulum-v1 --trust-policy` judges it.
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from surrogym_client.sb3 import SurrogateVecEnv


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    given = parser.parse_args()

    env = VecMonitor(SurrogateVecEnv(given.url, given.surrogate, num_envs=64, seed=0))
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=256,
        gamma=0.98,
        gae_lambda=0.9,
        learning_rate=1e-3,
        seed=0,
        device="cpu",
        tensorboard_log="runs/sb3",
    )
    model.learn(given.steps)
    mean, deviation = evaluate_policy(model, env, n_eval_episodes=64)
    print(f"imagined return: {mean:.1f}, deviation {deviation:.1f} over 64 episodes")
    model.save("sb3.zip")
    env.close()


if __name__ == "__main__":
    main()
