"""PPO of RLlib; its env runners open sessions of their own, here or on other machines.

pip install ".[rllib]"
python train_rllib.py pendulum --iterations 20
"""

import argparse

import gymnasium
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env

import surrogym_client


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--runners", type=int, default=0, help="processes that step; 0 steps in this one")
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    given = parser.parse_args()

    def make(options):
        surrogym_client.register()  # a runner is another process
        return gymnasium.make("surrogym/Remote-v0", **options)

    register_env("surrogate", make)
    config = (
        PPOConfig()
        .environment("surrogate", env_config={"url": given.url, "surrogate": given.surrogate})
        .env_runners(num_env_runners=given.runners, num_envs_per_env_runner=8)
        .training(lr=1e-3, gamma=0.98, lambda_=0.9, train_batch_size_per_learner=1024, minibatch_size=256, num_epochs=8)
        .debugging(seed=0)
    )
    algorithm = config.build_algo()
    for iteration in range(1, given.iterations + 1):
        runners = algorithm.train()["env_runners"]
        print(f"iteration {iteration}: imagined return {runners.get('episode_return_mean', float('nan')):.1f}")
    algorithm.stop()


if __name__ == "__main__":
    main()
