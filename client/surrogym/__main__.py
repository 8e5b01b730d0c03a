"""``python -m surrogym``: the ``surrogym`` command."""

from surrogym.cli import main

if __name__ == "__main__":
    main()
