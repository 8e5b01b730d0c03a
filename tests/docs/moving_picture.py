"""The moving picture of the README: samples of Pendulum, the uncertainty of its model, and a policy that acts.

Usage: python tests/docs/moving_picture.py [docs/images/pendulum.gif]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.animation import PillowWriter
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

import surrogym
from surrogym_sampler import original
from surrogym_server.sampling.uncertainty import query_uncertainty
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train

OUT = Path(__file__).parents[2] / "docs" / "images" / "pendulum.gif"
THETA, SPEED = np.linspace(-np.pi, np.pi, 81), np.linspace(-8, 8, 61)
UNKNOWN = 10.0  # tolerances; the end of the colour scale
VIRTUAL_STEPS, EPISODE_STEPS, HANGING = 450_000, 80, (np.pi - 0.05, 0.0)
FRAMES_PER_SECOND, FRAMES_PER_SAMPLE = 12, 8
Array = NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """One picture: samples (n, 2), uncertainty in tolerances (61, 81), the angle of the pole, and a line of text."""

    samples: Array
    map: Array
    angle: float
    words: str


def uncertainty(design: surrogym.Design) -> Array:
    """Largest standard deviation of the outputs without a torque, in tolerances."""
    if not design.fidelity:
        return np.full((len(SPEED), len(THETA)), UNKNOWN)
    points = np.stack(np.meshgrid(THETA, SPEED), axis=-1).reshape(-1, 2)
    tolerances = [output["tolerance"] for output in design.fidelity["outputs"]]
    model = design.surrogate()._model
    with torch.inference_mode():
        found = query_uncertainty(model, points, np.zeros((len(points), 1)), np.array(tolerances), None)
    return (found.deviation / np.array(tolerances)).max(axis=-1).reshape(len(SPEED), len(THETA))


def learn() -> tuple[surrogym.Design, list[Frame]]:
    machine = original.make("Pendulum-v1")
    design = surrogym.Design(machine.spec(), budget=20)
    samples, frames = np.empty((0, 2)), []
    while (query := design.ask()) is not None:
        step = machine.step_from(np.array(query.coordinates), np.array(query.action))
        design.tell(query, step)
        samples = np.vstack([samples, step.coordinates])
        frames += [Frame(samples, uncertainty(design), np.pi, f"real steps: {len(samples)}")] * FRAMES_PER_SAMPLE
    known = Frame(samples, uncertainty(design), np.pi, f"{len(samples)} real steps, the model is ready")
    return design, [*frames, *[known] * 2 * FRAMES_PER_SAMPLE]


def swing(design: surrogym.Design, known: Frame) -> Iterator[Frame]:
    """An episode of the original environment, by a policy that was trained in the model alone."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "policy.zip"
        train(design.surrogate(), file, TrainSettings(total_steps=VIRTUAL_STEPS, prolong=False))
        act = load_policy(file)
    env = gymnasium.make("Pendulum-v1")
    env.reset(seed=0)
    env.unwrapped.state = np.array(HANGING)
    observation = np.array([np.cos(HANGING[0]), np.sin(HANGING[0]), HANGING[1]], dtype=np.float32)
    total = 0.0
    for _ in range(EPISODE_STEPS):
        angle = float(np.arctan2(observation[1], observation[0]))
        yield Frame(known.samples, known.map, angle, "the policy in the original environment")
        observation, reward, *_ = env.step(act(observation[None])[0])
        total += float(reward)
    print(f"return of {EPISODE_STEPS} steps: {total:.1f}, angle at the end: {angle:.3f}")


def draw(frames: list[Frame], out: Path) -> None:
    figure, (map_axes, pole_axes) = plt.subplots(1, 2, figsize=(7.2, 3.2), dpi=100, width_ratios=(1.35, 1))
    writer = PillowWriter(fps=FRAMES_PER_SECOND)
    with writer.saving(figure, str(out), dpi=100):
        for frame in frames:
            draw_map(map_axes, frame)
            draw_pole(pole_axes, frame)
            figure.subplots_adjust(left=0.09, right=0.98, bottom=0.16, top=0.88, wspace=0.1)
            writer.grab_frame()


def draw_map(axes: plt.Axes, frame: Frame) -> None:
    axes.clear()
    shown = np.clip(frame.map, UNKNOWN / 100, UNKNOWN)
    scale = LogNorm(UNKNOWN / 100, UNKNOWN)
    axes.pcolormesh(THETA, SPEED, shown, cmap="Oranges", norm=scale, shading="nearest", rasterized=True)
    axes.plot(*frame.samples.T, "o", color="#1f4e9c", markersize=7)
    axes.set(
        xlim=(-np.pi, np.pi),
        ylim=(-8, 8),
        xlabel="angle (rad)",
        ylabel="speed (rad/s)",
        title="what the model does not know",
    )
    axes.set(xticks=(-3, 0, 3), yticks=(-8, 0, 8))


def draw_pole(axes: plt.Axes, frame: Frame) -> None:
    axes.clear()
    tip = np.sin(-frame.angle), np.cos(frame.angle)
    axes.plot((0, tip[0]), (0, tip[1]), color="#0b5d5e", linewidth=9, solid_capstyle="round")
    axes.plot(0, 0, "o", color="black", markersize=5)
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.3, 1.3), aspect="equal")
    axes.set_title(frame.words, fontsize=9)
    axes.axis("off")


def main(out: Path = OUT) -> None:
    design, frames = learn()
    draw([*frames, *list(swing(design, frames[-1]))[::2]], out)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
