"""How much a server keeps of many policies with large files: its folder, its database, its memory.

python lab/benchmarks/bench_policies.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from support.policies import network_file
from support.server import ServerProcess, running_server
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire

POLICIES, VIDEOS, ROOM = 220, 64, 256  # videos of 16 MiB; MiB of a surrogate's files
VIDEO = b"GIF89a" + bytes(16 * 2**20)
MEBIBYTE = 2**20
NAME = "many"


def state(server: ServerProcess) -> str:
    """Megabytes of files, of the database with its log, and of the server's memory."""
    files = sum(path.stat().st_size for path in (server.folder / "surrogym.db.files").iterdir())
    database = sum(path.stat().st_size for path in server.folder.glob("surrogym.db*") if path.is_file())
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    resident = int(status.split("VmRSS:")[1].split()[0]) / 1024
    return f"{files / MEBIBYTE:.0f} MiB of files, {database / MEBIBYTE:.1f} of database, {resident:.0f} of memory"


def main() -> None:
    with (
        TemporaryDirectory() as folder,
        running_server(Path(folder), SURROGYM_POLICIES_MIB=str(ROOM)) as server,
        Api(server.url) as api,
    ):
        api.create_surrogate(NAME, pendulum())
        for number in range(POLICIES):
            card = wire.PushedCard(algorithm="PPO", spec=pendulum(), settings={"number": number})
            version = api.policies.push(NAME, card, [], "zip", network_file(number)).version
            if number == 0:
                api.policies.put_alias(NAME, "production", version)
                print(f"one policy: {state(server)}")
        print(f"{POLICIES} policies, of which {len(api.policies.list(NAME))} are kept: {state(server)}")
        for number in range(VIDEOS):
            api.policies.put_file(NAME, POLICIES - number, "gif", VIDEO)
            if number % 16 == 15:
                print(f"{number + 1} videos, {(number + 1) * len(VIDEO) / 2**30:.2f} GiB: {state(server)}")
        kept = api.policies.get(NAME, "production")
        print(f"production is version {kept.version}, its file {'is there' if kept.files[0].stored else 'is missing'}")


if __name__ == "__main__":
    main()
