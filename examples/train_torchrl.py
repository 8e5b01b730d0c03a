"""PPO of TorchRL through its GymWrapper.

pip install ".[torchrl]"
python train_torchrl.py pendulum --steps 50000
"""

import argparse

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import surrogym_client  # enters surrogym/Remote-v0 into Gymnasium's registry

LANES, EPOCHS, BATCH = 32, 8, 256


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    given = parser.parse_args()
    torch.manual_seed(0)

    lanes = gymnasium.make_vec(
        "surrogym/Remote-v0",
        num_envs=LANES,
        url=given.url,
        surrogate=given.surrogate,
        seed=0,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    env = TransformedEnv(GymWrapper(lanes))
    env.append_transform(RewardSum())
    env.append_transform(StepCounter())
    size = lanes.single_action_space.shape[0]
    low, high = (torch.as_tensor(limit) for limit in (lanes.single_action_space.low, lanes.single_action_space.high))

    network = nn.Sequential(
        nn.LazyLinear(64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 2 * size), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        spec=env.action_spec,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
    )
    critic = ValueOperator(
        nn.Sequential(nn.LazyLinear(64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)),
        in_keys=["observation"],
    )
    example = env.reset()
    actor(example)
    critic(example)
    advantage = GAE(gamma=0.98, lmbda=0.9, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.001)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)

    collector = Collector(env, actor, frames_per_batch=LANES * 32, total_frames=given.steps)
    for rollout in collector:
        advantage(rollout)
        rows = rollout.reshape(-1)
        for _ in range(EPOCHS):
            for chosen in torch.randperm(len(rows)).split(BATCH):
                losses = loss(rows[chosen])
                total = sum(value for name, value in losses.items() if name.startswith("loss_"))
                optimiser.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        done = rollout["next", "done"].squeeze(-1)
        if done.any():
            print(f"imagined return {rollout['next', 'episode_reward'][done].mean():.1f}")
    torch.save(actor.state_dict(), "torchrl.pt")
    collector.shutdown()


if __name__ == "__main__":
    main()
