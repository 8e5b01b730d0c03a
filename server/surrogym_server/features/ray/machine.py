"""Kind of a machine. On machines of one kind, with the same versions, a step gives the same bits."""

from __future__ import annotations

import platform
from pathlib import Path
from zlib import crc32

import torch

PROCESSORS = Path("/proc/cpuinfo")
NAMES = ("model name", "flags", "Features")


def machine_kind(device: str, threads: int) -> str:
    """Return the kind of processor, the number of threads of one operation, and the device, as one text.

    If one of these differs, sums may be added in another order or rounded differently.
    """
    parts = [platform.machine(), _processor(), f"threads {threads}"]
    return ", ".join([*parts, torch.cuda.get_device_name() if device == "cuda" else device])


def _processor() -> str:
    """Return the name of the first processor, and a digest of its features."""
    try:
        lines = PROCESSORS.read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    name, *abilities = (told.get(name, "") for name in NAMES)
    return f"{name} {crc32(' '.join(abilities).encode()):08x}"
