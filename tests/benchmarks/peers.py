"""Other systems serving a trivial environment; runs in an environment of their own, see bench_peers.py.

``peers.py serve NAME PORT`` serves it; ``peers.py step NAME PORT`` answers each line of its input, a number, by a line
with the seconds of so many steps, as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from concurrent import futures


def serve_dm_env_rpc(port: int) -> None:
    import grpc
    from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
    from dm_env_rpc.v1 import dm_env_rpc_pb2_grpc, tensor_utils

    def spec(name: str, shape: tuple[int, ...]) -> pb.TensorSpec:
        return pb.TensorSpec(name=name, shape=shape, dtype=pb.DataType.FLOAT)

    class Servicer(dm_env_rpc_pb2_grpc.EnvironmentServicer):
        def Process(self, requests, context):  # type: ignore[no-untyped-def]
            shown = tensor_utils.pack_tensor([0.0] * 3, dtype="float32")
            for request in requests:
                reply = pb.EnvironmentResponse()
                match request.WhichOneof("payload"):
                    case "create_world":
                        reply.create_world.world_name = "trivial"
                    case "join_world" | "reset" as what:
                        specs = getattr(reply, what).specs
                        specs.actions[1].CopyFrom(spec("action", (1,)))
                        specs.observations[1].CopyFrom(spec("shown", (3,)))
                    case "step":
                        reply.step.state = pb.EnvironmentStateType.RUNNING
                        reply.step.observations[1].CopyFrom(shown)
                    case other:
                        getattr(reply, other).SetInParent()
                yield reply

    server = grpc.server(futures.ThreadPoolExecutor(1))
    dm_env_rpc_pb2_grpc.add_EnvironmentServicer_to_server(Servicer(), server)
    server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    server.wait_for_termination()


def step_dm_env_rpc(port: int):  # type: ignore[no-untyped-def]
    import grpc
    import numpy as np
    from dm_env_rpc.v1 import connection, dm_env_adaptor

    channel = grpc.insecure_channel(f"127.0.0.1:{port}")
    env, _ = dm_env_adaptor.create_and_join_world(connection.Connection(channel), {}, {})
    env.reset()
    action = {"action": np.zeros(1, np.float32)}
    return lambda: env.step(action)


def serve_rlmesh(port: int) -> None:
    import gymnasium
    import numpy as np
    from rlmesh import EnvServer

    class Trivial(gymnasium.Env):  # type: ignore[type-arg]
        observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
        action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

        def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
            return np.zeros(3, np.float32), {}

        def step(self, action):  # type: ignore[no-untyped-def]
            return np.zeros(3, np.float32), 0.0, False, False, {}

    EnvServer(Trivial(), f"127.0.0.1:{port}").serve()


def step_rlmesh(port: int):  # type: ignore[no-untyped-def]
    import numpy as np
    from rlmesh.numpy import RemoteEnv

    env = RemoteEnv(f"127.0.0.1:{port}")
    env.reset(seed=0)
    action = np.zeros(1, np.float32)
    return lambda: env.step(action)


def serve_openenv(port: int) -> None:
    import uvicorn
    from openenv.core.env_server.http_server import create_app
    from openenv.core.env_server.interfaces import Environment
    from openenv.core.env_server.types import Action, Observation, State

    class Push(Action):
        u: list[float]

    class Shown(Observation):
        x: list[float]

    class Trivial(Environment):  # type: ignore[type-arg]
        def reset(self, seed=None, episode_id=None, **_):  # type: ignore[no-untyped-def]
            return Shown(x=[0.0] * 3, reward=0.0)

        def step(self, action, timeout_s=None, **_):  # type: ignore[no-untyped-def]
            return Shown(x=[0.0] * 3, reward=0.0)

        @property
        def state(self):  # type: ignore[no-untyped-def]
            return State()

    uvicorn.run(create_app(Trivial, Push, Shown), port=port, log_level="warning", access_log=False)


def step_openenv(port: int):  # type: ignore[no-untyped-def]
    from openenv.core.generic_client import GenericEnvClient

    env = GenericEnvClient(base_url=f"http://127.0.0.1:{port}").connect()
    env.reset()
    action = {"u": [0.0]}
    return lambda: env.step(action)


def answer(step) -> None:  # type: ignore[no-untyped-def]
    print(json.dumps([]), flush=True)  # ready
    for line in sys.stdin:
        taken = []
        for _ in range(int(line)):
            start = time.perf_counter()
            step()
            taken.append(time.perf_counter() - start)
        print(json.dumps(taken), flush=True)


if __name__ == "__main__":
    what, name, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
    found = globals()[f"{what}_{name}"](port)
    if what == "step":
        answer(found)
