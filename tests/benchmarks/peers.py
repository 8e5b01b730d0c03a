"""Other systems serving a trivial environment, and other libraries predicting; runs where they are installed, owned.py.

``peers.py serve NAME PORT`` serves it. ``peers.py step NAME PORT`` and ``peers.py predict NAME FILE`` answer each line
of their input, a number, by a line with the seconds of so many calls, as JSON. FILE (NPZ) says what to predict, and
what was predicted is written beside it.
"""

from __future__ import annotations

import asyncio
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

    env, loop = GenericEnvClient(base_url=f"http://127.0.0.1:{port}"), asyncio.new_event_loop()
    loop.run_until_complete(env.connect())
    loop.run_until_complete(env.reset())
    action = {"u": [0.0]}
    return lambda: loop.run_until_complete(env.step(action))


def predict_scikit_learn(file: str):  # type: ignore[no-untyped-def]
    import numpy as np
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    told = np.load(file)
    kernel = ConstantKernel(1.0, "fixed") * RBF(told["lengthscale"], "fixed")
    fitted = [GaussianProcessRegressor(kernel, alpha=float(told["noise"])).fit(told["x"], y) for y in told["y"]]

    def predict():  # type: ignore[no-untyped-def]
        return [regressor.predict(told["at"], return_std=True) for regressor in fitted]

    mean, deviation = (np.stack(part, -1) for part in zip(*predict(), strict=True))
    np.savez(f"{file}.predicted", mean=mean, deviation=deviation)
    return predict


def predict_gpytorch(file: str):  # type: ignore[no-untyped-def]
    return _gpytorch(file, fast_variance=False)


def predict_gpytorch_fast(file: str):  # type: ignore[no-untyped-def]
    return _gpytorch(file, fast_variance=True)


def _gpytorch(file: str, fast_variance: bool):  # type: ignore[no-untyped-def]
    """All outputs as one batch of independent processes, as GPyTorch recommends."""
    import gpytorch
    import numpy as np
    import torch

    torch.set_num_threads(1)
    told = {name: torch.from_numpy(array) for name, array in np.load(file).items()}
    outputs, inputs = len(told["y"]), told["x"].shape[1]
    batch = torch.Size([outputs])
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=batch)
    likelihood.noise = float(told["noise"])

    class Processes(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(told["x"].expand(outputs, -1, -1), told["y"], likelihood)
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
            rbf = gpytorch.kernels.RBFKernel(ard_num_dims=inputs, batch_shape=batch)
            self.covar_module = gpytorch.kernels.ScaleKernel(rbf, batch_shape=batch)
            self.covar_module.outputscale, rbf.lengthscale = 1.0, told["lengthscale"]

        def forward(self, x):  # type: ignore[no-untyped-def]
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    model = Processes().double().eval()
    repeated = told["at"].expand(outputs, *told["at"].shape)

    def predict():  # type: ignore[no-untyped-def]
        with torch.no_grad(), gpytorch.settings.fast_pred_var(fast_variance):
            predicted = model(repeated)
            return predicted.mean, predicted.variance

    mean, variance = predict()
    np.savez(f"{file}.predicted", mean=mean.T.numpy(), deviation=variance.T.sqrt().numpy())
    return predict


def answer(call) -> None:  # type: ignore[no-untyped-def]
    print(json.dumps([]), flush=True)  # ready
    for line in sys.stdin:
        taken = []
        for _ in range(int(line)):
            start = time.perf_counter()
            call()
            taken.append(time.perf_counter() - start)
        print(json.dumps(taken), flush=True)


if __name__ == "__main__":
    what, name, where = sys.argv[1:]
    found = globals()[f"{what}_{name}"](where if what == "predict" else int(where))
    if what != "serve":
        answer(found)
