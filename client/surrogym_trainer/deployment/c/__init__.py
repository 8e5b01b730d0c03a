"""Controllers in C99: a header, a source, and a program that runs test vectors."""

from surrogym_trainer.deployment.c.files import running, write, write_arduino

__all__ = ["running", "write", "write_arduino"]
