"""The Surrogym client: remote environments, the sampler, training and evaluation.

Importing it enters ``surrogym/Remote-v0`` into Gymnasium's registry: at once where Gymnasium is loaded, otherwise as
soon as it is. Most commands never load it. Gymnasium has looked for no plugins by itself since 1.0.
``gymnasium.make("surrogym_client:surrogym/Remote-v0", ...)`` needs no import.
"""

from surrogym_client.runtime.after_import import after_import

after_import("gymnasium", "surrogym_client.registration:register")


def register() -> None:
    """Register ``surrogym/Remote-v0`` with Gymnasium now.

    Importing this package does so by itself. Worker processes that were forked before Gymnasium was loaded call this.
    """
    from surrogym_client.registration import register as enter

    enter()
