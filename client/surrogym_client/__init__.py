"""The thin client of Surrogym: virtual environments over HTTP and the stream, for Gymnasium and Stable-Baselines3.

Importing this package registers ``surrogym/Remote-v0`` with Gymnasium: at once if Gymnasium is loaded, otherwise as
soon as it is. This keeps commands that don't need Gymnasium fast. Since version 1.0, Gymnasium does not search for
plug-ins itself. ``gymnasium.make("surrogym_client:surrogym/Remote-v0", ...)`` works without an import.
"""

from surrogym_client.runtime.after_import import after_import

after_import("gymnasium", "surrogym_client.registration:register")


def register() -> None:
    """Register ``surrogym/Remote-v0`` with Gymnasium now.

    Importing this package does so automatically. Only worker processes that were forked before Gymnasium was loaded
    need to call this function.
    """
    from surrogym_client.registration import register as enter

    enter()
