"""Any environment that has a name: described, learned from a few real steps, and stepped, all in this process.

python by_name.py Swimmer-v5
python by_name.py dm_control:pendulum-swingup     # pip install ".[dm-control]"
python by_name.py gymnasium_robotics:PointMaze_UMaze-v3 --steps 40    # pip install ".[robotics]"
python by_name.py pcgym:cstr    # pip install ".[pcgym]"
"""

import argparse

import numpy as np

import surrogym
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe

parser = argparse.ArgumentParser()
parser.add_argument("name")
parser.add_argument("--steps", type=int, default=20, help="real steps of the design")
parser.add_argument("--exploring", type=int, default=200, help="real steps of the description")
options = parser.parse_args()

description = describe(options.name, options.exploring)
print(*description.words(), sep="\n")

machine = original.make(options.name, spec=description.spec, budget=options.steps)
design = surrogym.Design(machine.spec())
while (query := design.ask()) is not None:
    design.tell(query, machine.step_from(np.array(query.coordinates), np.array(query.action)))
machine.close()
print(f"{design.steps} real steps of the design, confidence index {design.fidelity['confidence_index']:.4f}")

env = surrogym.make(design)
observation, _ = env.reset(seed=0)
observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
print(f"a virtual step: reward {reward:.3f}")
env.close()
