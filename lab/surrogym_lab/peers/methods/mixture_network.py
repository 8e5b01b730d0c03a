"""A recurrent network with a mixture density output, for observations, rewards and ends of episodes (torch).

D. Ha, J. Schmidhuber, "Recurrent World Models Facilitate Policy Evolution", NeurIPS 2018 (arXiv 1809.01999). Single
precision.

Shapes: n episodes, T steps, D observation entries, F action entries, E = D + 1 outputs, K components, H hidden units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from surrogym_lab.peers.methods.ensemble import moments

LOWEST = -5.0  # log deviation of a component, in deviations of the output
RESTART = 10.0  # weight of an end in the loss; that of the authors' dream
CLIP = 1.0  # largest entry of a gradient

State = tuple[Tensor, Tensor]
"""Hidden and cell state, (1, n, H) each."""


class Episode(NamedTuple):
    """A real episode: observations (T + 1, D), actions (T, F), rewards (T,), and whether its last step ended it."""

    seen: Tensor
    action: Tensor
    reward: Tensor
    ended: bool


class MixtureNetwork(nn.Module):
    """Long short-term memory from observation and action to mixtures of normal distributions, one for the reward and
    for the change of each observation entry, and to the logit of the episode's end.

    Args:
        seen, action: numbers D and F.
        hidden: H.
        components: K.
    """

    def __init__(self, seen: int, action: int, hidden: int, components: int) -> None:
        super().__init__()
        self.outputs = seen + 1
        self.memory = nn.LSTM(seen + action, hidden, batch_first=True)
        self.head = nn.Linear(hidden, 3 * self.outputs * components + 1)
        self.middle, self.spread = torch.zeros(seen), torch.ones(seen)
        self.out_middle, self.out_spread = torch.zeros(self.outputs), torch.ones(self.outputs)

    def scale_by(self, episodes: Sequence[Episode]) -> None:
        """Take means and deviations of observations and outputs."""
        self.middle, self.spread = moments(torch.cat([part.seen for part in episodes]))
        self.out_middle, self.out_spread = moments(torch.cat([_targets(part) for part in episodes]))

    def scaled(self, seen: Tensor) -> Tensor:
        """Observations (..., D) in deviations from their mean."""
        return (seen - self.middle) / self.spread

    def start(self, count: int) -> State:
        """The state (1, n, H) before the first step."""
        zero = torch.zeros(1, count, self.memory.hidden_size)
        return zero, zero

    def forward(self, seen: Tensor, action: Tensor, state: State) -> tuple[Tensor, Tensor, Tensor, Tensor, State]:
        """Log weights, means and log deviations (n, T, E, K) of scaled outputs, logits (n, T) of ends, and the state
        after observations (n, T, D) and actions (n, T, F)."""
        hidden, state = self.memory(torch.cat([self.scaled(seen), action], -1), state)
        out = self.head(hidden)
        weight, mean, deviation = out[..., 1:].reshape(*out.shape[:-1], 3, self.outputs, -1).unbind(-3)
        return weight.log_softmax(-1), mean, deviation.clamp_min(LOWEST), out[..., 0], state

    def drawn(
        self, seen: Tensor, action: Tensor, state: State, noise: tuple[Tensor, Tensor], temperature: float
    ) -> tuple[Tensor, Tensor, Tensor, State]:
        """Draw one step.

        Args:
            seen, action: (n, D) and (n, F).
            state: before the step.
            noise: uniform and normal numbers (n, E), which choose the components and the places in them.
            temperature: of the draw; its root multiplies the deviations.

        Returns:
            rewards (n,), reached observations (n, D), whether the episodes end (n,), and the state after the step.
        """
        weight, mean, deviation, logit, state = self(seen[:, None], action[:, None], state)
        shares = (weight[:, 0] / temperature).softmax(-1).cumsum(-1)
        chosen = (noise[0][..., None] > shares[..., :-1]).sum(-1, keepdim=True)
        mean, deviation = (part[:, 0].gather(-1, chosen)[..., 0] for part in (mean, deviation))
        scaled = mean + temperature**0.5 * deviation.exp() * noise[1]
        outputs = self.out_middle + self.out_spread * scaled
        return outputs[:, 0], seen + outputs[:, 1:], logit[:, 0] > 0, state

    def loss(self, episodes: Sequence[Episode]) -> Tensor:
        """Negative log likelihood of the outputs, mean over steps and outputs, and of the ends."""
        seen, action, wanted, ended = (nn.utils.rnn.pad_sequence(part, batch_first=True) for part in _padded(episodes))
        mask = nn.utils.rnn.pad_sequence([torch.ones(len(part.reward)) for part in episodes], batch_first=True) > 0
        weight, mean, deviation, logit, _ = self(seen, action, self.start(len(episodes)))
        scaled = ((wanted - self.out_middle) / self.out_spread)[..., None]
        each = weight - deviation - ((scaled - mean) / deviation.exp()) ** 2 / 2
        ends = nn.functional.binary_cross_entropy_with_logits(
            logit[mask], ended[mask], pos_weight=torch.tensor(RESTART)
        )
        total: Tensor = ends - each.logsumexp(-1)[mask].mean()
        return total


def train(
    model: MixtureNetwork,
    optimizer: torch.optim.Optimizer,
    episodes: Sequence[Episode],
    steps: int,
    check: Callable[[], None],
) -> None:
    """Continue the training. Each of the ``steps`` is a gradient step on all episodes, and calls ``check`` first."""
    model.scale_by(episodes)
    for _ in range(steps):
        check()
        optimizer.zero_grad()
        model.loss(episodes).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_value_(model.parameters(), CLIP)
        optimizer.step()


def _targets(episode: Episode) -> Tensor:
    """Rewards and changes (T, E)."""
    return torch.cat([episode.reward[:, None], episode.seen.diff(dim=0)], 1)


def _padded(episodes: Sequence[Episode]) -> tuple[list[Tensor], ...]:
    """Observations, actions, outputs and ends of each episode."""
    ends = [torch.zeros(len(part.reward)) for part in episodes]
    for end, part in zip(ends, episodes, strict=True):
        end[-1] = float(part.ended)
    return [p.seen[:-1] for p in episodes], [p.action for p in episodes], [_targets(p) for p in episodes], ends
