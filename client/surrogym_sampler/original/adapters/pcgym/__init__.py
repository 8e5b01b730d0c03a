"""The adapter for models of pc-gym: ``adapter`` opens a model by its name or a file of parameters, ``file`` checks such
a file."""
