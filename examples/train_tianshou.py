"""PPO of tianshou: its collector talks to each lane by itself, and a step of all lanes is one request.

pip install ".[tianshou]"
python train_tianshou.py pendulum --steps 50000

For continuous actions.
"""

import argparse

import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Independent, Normal

from surrogym_client.tianshou import SurrogateVectorEnv

LANES, ROLLOUT = 32, 1024


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    given = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)

    lanes = SurrogateVectorEnv(given.url, given.surrogate, num_envs=LANES, seed=0)
    observations, actions = lanes.get_env_attr("observation_space", 0)[0], lanes.get_env_attr("action_space", 0)[0]
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=observations.shape, hidden_sizes=(64, 64), activation=torch.nn.Tanh),
        action_shape=actions.shape,
        unbounded=True,
    )
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda loc_scale: Independent(Normal(*loc_scale), 1),
        action_space=actions,
        deterministic_eval=True,
    )
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(
            preprocess_net=Net(state_shape=observations.shape, hidden_sizes=(64, 64), activation=torch.nn.Tanh)
        ),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=0.98,
        gae_lambda=0.9,
        ent_coef=0.0,
        return_scaling=True,
        max_grad_norm=0.5,
    )
    collector = Collector(algorithm, lanes, VectorReplayBuffer(ROLLOUT, LANES))
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1,
            epoch_num_steps=given.steps,
            collection_step_num_env_steps=ROLLOUT,
            update_step_num_repetitions=8,
            batch_size=256,
            show_progress=False,
            verbose=False,
        )
    )
    collector.reset()
    returns = collector.collect(n_episode=64).returns
    print(f"imagined return: {returns.mean():.1f}, deviation {returns.std():.1f} over {len(returns)} episodes")
    torch.save(algorithm.state_dict(), "tianshou.pt")
    lanes.close()


if __name__ == "__main__":
    main()
