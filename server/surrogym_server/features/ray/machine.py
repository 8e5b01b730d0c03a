"""Kind of a machine: on machines of one kind, with the same versions of packages, a step gives the same bits."""

from __future__ import annotations

import platform
from pathlib import Path
from zlib import crc32

import torch

PROCESSORS = Path("/proc/cpuinfo")
NAMES = ("model name", "flags", "Features")


def machine_kind(device: str, threads: int) -> str:
    """Describe processor, number of threads and device as one text, which is equal on machines that round equally.

    Args:
        device: "cpu" or "cuda".
        threads: number of threads of a torch operation.
    """
    parts = [platform.machine(), _processor(), f"threads {threads}"]
    return ", ".join([*parts, torch.cuda.get_device_name() if device == "cuda" else device])


def _processor() -> str:
    """Return the name of the first processor, and a hash of its instruction sets."""
    try:
        lines = PROCESSORS.read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    name, *abilities = (told.get(name, "") for name in NAMES)
    return f"{name} {crc32(' '.join(abilities).encode()):08x}"
