"""The Surrogym client: remote environments, the sampler, training and evaluation.

Importing it enters ``surrogym/Remote-v0`` into Gymnasium's registry: the one thing an import does here,
because Gymnasium has looked for no plugins by itself since 1.0.
``gymnasium.make("surrogym_client:surrogym/Remote-v0", ...)`` needs no import.
"""

from surrogym_client.registration import register

register()
