"""Original environments behind a program that answers one line of JSON with one line of JSON."""

from surrogym_sampler.original.executables.environment import Executable, is_executable, name_of, open_executable

__all__ = ["Executable", "is_executable", "name_of", "open_executable"]
