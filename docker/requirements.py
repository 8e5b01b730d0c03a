"""Prints the requirements of some extras, so that an image can have them in a layer below the project's own code."""

import sys
import tomllib
from pathlib import Path


def main(extras: list[str]) -> None:
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    chosen = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    sys.stdout.writelines(f"{requirement}\n" for group in chosen for requirement in group)


if __name__ == "__main__":
    main(sys.argv[1:])
