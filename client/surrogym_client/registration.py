"""Register environments with Gymnasium: surrogates on a server, surrogates in files, and the swing-up of a pole on a
cart."""

from __future__ import annotations

ENVIRONMENT_ID = "surrogym/Remote-v0"
FILE_ID = "surrogym/File-v0"
SWING_UP = "surrogym/CartPoleSwingUp-v0"
SWING_UP_NARROW = "surrogym/CartPoleSwingUpNarrow-v0"
SWING_UP_STEPS = 40  # time limit of an episode, in steps of 0.1 s


def register() -> None:
    """Register this package's environments with Gymnasium. Repeating it is harmless."""
    import gymnasium  # imported here, so that importing this module does not load Gymnasium

    for environment_id, module in ((ENVIRONMENT_ID, "gym_factories"), (FILE_ID, "file_factories")):
        if environment_id not in gymnasium.registry:
            gymnasium.register(
                environment_id,
                entry_point=f"surrogym_client.environments.{module}:make_env",
                vector_entry_point=f"surrogym_client.environments.{module}:make_vector_env",
            )
    for environment_id, reward in ((SWING_UP, "smooth"), (SWING_UP_NARROW, "narrow")):
        if environment_id not in gymnasium.registry:
            gymnasium.register(
                environment_id,
                entry_point="surrogym_sampler.original.swingup:CartPoleSwingUp",
                max_episode_steps=SWING_UP_STEPS,
                kwargs={"reward": reward},
            )
