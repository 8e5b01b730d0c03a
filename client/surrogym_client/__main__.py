"""``python -m surrogym_client``: the ``surrogym`` command."""

from surrogym_client.cli import main

if __name__ == "__main__":
    main()
