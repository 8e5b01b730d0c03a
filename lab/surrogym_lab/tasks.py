"""Tasks of the studies: those of the demo, ten that nobody tunes the method on, and environments of other packages."""

from __future__ import annotations

from surrogym.demo.tasks import TASKS, DemoTask, Target

# Ten tasks of the study of trust. Nobody tunes the method on them. Targets: four fifths of the way from no action to a
# policy that CMA-ES learned on the task itself (lab/benchmarks/unseen_targets.py).
UNSEEN = {
    name: DemoTask(f"surrogym_lab.unseen.tasks:{kind}", budget, Target(f"mean {mean:g}", mean=mean))
    for name, kind, budget, mean in (
        ("narrow-plane", "NarrowPlane", 100, 67),
        ("narrow-arm", "NarrowArm", 150, 70),
        ("kinetics", "Kinetics", 100, -97),
        ("stick-slip", "StickSlip", 60, -5.3),
        ("process-noise", "NoisyPendulum", 100, -380),
        ("sensor-noise", "NoisySensors", 100, -30),
        ("contact", "Contact", 100, -34),
        ("fast-and-slow", "FastAndSlow", 60, -30),
        ("spring-chain", "SpringChain", 150, -51),
        ("reset-only", "ResetOnly", 150, -19),
    )
}

# Environments of other packages, described by random steps before the design. The targets of dm_control's tasks are
# above what TD-MPC2 reaches with 100,000 steps (724, 839 and 937). The tank's is 5 % below its own oracle (-0.0118).
BY_NAME = {
    "dm-pendulum": DemoTask("dm_control:pendulum-swingup", 60, Target("mean 750", mean=750)),
    "dm-cartpole": DemoTask("dm_control:cartpole-swingup", 100, Target("mean 860", mean=860)),
    "dm-reacher": DemoTask("dm_control:reacher-easy", 300, Target("mean 950", mean=950)),
    "stirred-tank": DemoTask("pcgym:cstr", 100, Target("mean -0.0124", mean=-0.0124)),
    "swimmer": DemoTask("Swimmer-v5", 1_000, Target("mean 100", mean=100)),
}
EVERY_TASK = TASKS | UNSEEN | BY_NAME
