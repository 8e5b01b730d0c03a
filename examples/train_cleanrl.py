"""PPO in one file, torch alone, in the style of CleanRL: every line of the algorithm is here to be read and changed.

python train_cleanrl.py pendulum --steps 200000

For continuous actions. The vector environment resets its lanes by itself; where the time limit cut an episode, the
value of its last observation, which comes in ``final_obs``, takes the place of what would have followed.
"""

import argparse
import time

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import surrogym_client  # enters surrogym/Remote-v0 into Gymnasium's registry

LANES, ROLLOUT, EPOCHS, BATCHES = 64, 32, 10, 8
GAMMA, LAMBDA, CLIP, RATE, REWARD_SCALE = 0.98, 0.9, 0.2, 1e-3, 0.1


class Agent(nn.Module):
    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.actor = nn.Sequential(nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
        self.mean = nn.Linear(64, actions)
        self.log_std = nn.Parameter(torch.zeros(actions))
        self.critic = nn.Sequential(
            nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
        )

    def policy(self, observation: torch.Tensor) -> Normal:
        return Normal(self.mean(self.actor(observation)), self.log_std.exp())

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        return self.critic(observation).squeeze(-1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.manual_seed(given.seed)
    torch.set_num_threads(1)

    envs = gymnasium.make_vec(
        "surrogym/Remote-v0",
        num_envs=LANES,
        url=given.url,
        surrogate=given.surrogate,
        seed=given.seed,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    low, high = (torch.as_tensor(limit) for limit in (envs.single_action_space.low, envs.single_action_space.high))
    agent = Agent(envs.single_observation_space.shape[0], len(low))
    optimiser = torch.optim.Adam(agent.parameters(), lr=RATE)

    observation, _ = envs.reset(seed=given.seed)
    running, finished = np.zeros(LANES), [0.0]  # returns of episodes
    updates, started = max(given.steps // (LANES * ROLLOUT), 1), time.monotonic()
    for update in range(1, updates + 1):
        rows = []
        for _ in range(ROLLOUT):
            seen = torch.as_tensor(observation)
            with torch.no_grad():
                policy = agent.policy(seen)
                raw = policy.sample()
                action = low + (raw.clamp(-1, 1) + 1) / 2 * (high - low)
            observation, reward, terminated, truncated, infos = envs.step(action.numpy())
            following = observation.copy()
            ended = terminated | truncated
            for lane in np.flatnonzero(ended):
                following[lane] = infos["final_obs"][lane]
            running += reward
            finished += running[ended].tolist()
            running[ended] = 0
            with torch.no_grad():
                rows.append(
                    {
                        "observation": seen,
                        "action": raw,
                        "log_prob": policy.log_prob(raw).sum(-1),
                        "value": agent.value(seen),
                        "next_value": agent.value(torch.as_tensor(following)),
                        "reward": REWARD_SCALE * torch.as_tensor(reward, dtype=torch.float32),
                        "alive": torch.as_tensor(~terminated, dtype=torch.float32),
                        "goes_on": torch.as_tensor(~ended, dtype=torch.float32),
                    }
                )

        # generalised advantage estimation, backwards in time; it stops at an end, and bootstraps where time ran out
        advantage = torch.zeros(LANES)
        for row in reversed(rows):
            delta = row["reward"] + GAMMA * row["alive"] * row["next_value"] - row["value"]
            advantage = delta + GAMMA * LAMBDA * row["goes_on"] * advantage
            row["advantage"] = advantage
        batch = {name: torch.stack([row[name] for row in rows]).flatten(0, 1) for name in rows[0]}
        target = batch["advantage"] + batch["value"]

        for _ in range(EPOCHS):
            for chosen in torch.randperm(LANES * ROLLOUT).chunk(BATCHES):
                policy = agent.policy(batch["observation"][chosen])
                ratio = (policy.log_prob(batch["action"][chosen]).sum(-1) - batch["log_prob"][chosen]).exp()
                gain = batch["advantage"][chosen]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                actor_loss = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                critic_loss = (agent.value(batch["observation"][chosen]) - target[chosen]).square().mean()
                optimiser.zero_grad()
                (actor_loss + 0.5 * critic_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimiser.step()

        steps = update * LANES * ROLLOUT
        if update % 10 == 0 or update == updates:
            imagined = np.mean(finished[-100:])
            print(f"{steps} steps, imagined return {imagined:.1f}, {steps / (time.monotonic() - started):.0f} steps/s")

    torch.save(agent.state_dict(), "cleanrl.pt")
    envs.close()


if __name__ == "__main__":
    main()
