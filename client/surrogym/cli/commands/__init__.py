"""The commands of ``surrogym``, one file each, with a function ``register(app)``."""
