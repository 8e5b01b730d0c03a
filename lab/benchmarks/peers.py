"""Other systems serving a trivial environment, and other libraries predicting and fitting; runs where they are
installed, owned.py.

``peers.py serve NAME PORT`` serves it. ``peers.py step NAME PORT``, ``peers.py predict NAME FILE`` and ``peers.py fit
NAME FILE`` answer each line of their input, a number, by a line with the seconds of so many calls, as JSON. FILE (NPZ)
says what to predict or fit, and what was predicted or fitted is written beside it.
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

    told = dict(np.load(file))  # read once, not with each prediction
    kernel = ConstantKernel(1.0, "fixed") * RBF(told["lengthscale"], "fixed")
    fitted = [GaussianProcessRegressor(kernel, alpha=float(told["noise"])).fit(told["x"], y) for y in told["y"]]

    def predict():  # type: ignore[no-untyped-def]
        return [regressor.predict(told["at"], return_std=True) for regressor in fitted]

    mean, deviation = (np.stack(part, -1) for part in zip(*predict(), strict=True))
    np.savez(f"{file}.predicted", mean=mean, deviation=deviation)
    return predict


def predict_gpytorch(file: str):  # type: ignore[no-untyped-def]
    return _gpytorch_predicting(file, fast_variance=False)


def predict_gpytorch_fast(file: str):  # type: ignore[no-untyped-def]
    return _gpytorch_predicting(file, fast_variance=True)


def _gpytorch_predicting(file: str, fast_variance: bool):  # type: ignore[no-untyped-def]
    """All outputs as one batch of independent processes, as GPyTorch recommends."""
    import gpytorch
    import numpy as np
    import torch

    torch.set_num_threads(1)
    told = {name: torch.from_numpy(array) for name, array in np.load(file).items()}
    outputs = len(told["y"])
    model = _gpytorch(told["x"].expand(outputs, -1, -1), told["y"])
    model.covar_module.outputscale, model.covar_module.base_kernel.lengthscale = 1.0, told["lengthscale"]
    model.likelihood.noise = told["noise"]
    model.eval()
    repeated = told["at"].expand(outputs, *told["at"].shape)

    def predict():  # type: ignore[no-untyped-def]
        with torch.no_grad(), gpytorch.settings.fast_pred_var(fast_variance):
            predicted = model(repeated)
            return predicted.mean, predicted.variance

    mean, variance = predict()
    np.savez(f"{file}.predicted", mean=mean.T.numpy(), deviation=variance.T.sqrt().numpy())
    return predict


def _gpytorch(x, y):  # type: ignore[no-untyped-def]
    """A process of y (n,) or a batch of them (b, n); its parameters are logarithms, as ours."""
    import gpytorch
    import torch

    batch, inputs = y.shape[:-1], x.shape[-1]
    positive = gpytorch.constraints.Positive(transform=torch.exp, inv_transform=torch.log)

    class Process(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(x, y, gpytorch.likelihoods.GaussianLikelihood(None, positive, batch_shape=batch))
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
            rbf = gpytorch.kernels.RBFKernel(ard_num_dims=inputs, batch_shape=batch, lengthscale_constraint=positive)
            self.covar_module = gpytorch.kernels.ScaleKernel(rbf, outputscale_constraint=positive, batch_shape=batch)

        def forward(self, x):  # type: ignore[no-untyped-def]
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return Process().double()


def fit_scikit_learn(file: str):  # type: ignore[no-untyped-def]
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    def fit(x, y, told):  # type: ignore[no-untyped-def]
        found = []

        def optimizer(objective, start, bounds):  # type: ignore[no-untyped-def]
            found.append(_search(objective, told))
            return found[0].x, found[0].fun

        *lengthscale, signal, noise = told["start"]
        *lengthscales, signals, noises = told["bounds"]
        kernel = RBF(lengthscale, lengthscales) * ConstantKernel(signal, signals) + WhiteKernel(noise, noises)
        GaussianProcessRegressor(kernel, alpha=0, optimizer=optimizer).fit(x, y)
        return found[0]

    return _fitting(file, fit)


def fit_gpytorch(file: str):  # type: ignore[no-untyped-def]
    import gpytorch
    import torch
    from torch.nn.utils import vector_to_parameters

    torch.set_num_threads(1)

    def fit(x, y, told):  # type: ignore[no-untyped-def]
        x, y = torch.from_numpy(x), torch.from_numpy(y)
        model = _gpytorch(x, y)
        evidence = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)  # of one point
        scaled, noise = model.covar_module, model.likelihood.noise_covar
        parameters = [scaled.base_kernel.raw_lengthscale, scaled.raw_outputscale, noise.raw_noise]

        def objective(theta):  # type: ignore[no-untyped-def]
            vector_to_parameters(torch.from_numpy(theta), parameters)
            value = -len(y) * evidence(model(x), y)
            slopes = torch.autograd.grad(value, parameters)
            return value.item(), torch.cat([slope.flatten() for slope in slopes]).numpy()

        with gpytorch.settings.max_cholesky_size(len(y)):  # exact
            return _search(objective, told)

    return _fitting(file, fit)


def _fitting(file: str, fit):  # type: ignore[no-untyped-def]
    """A fit of each draw, one after the other."""
    import numpy as np

    told = dict(np.load(file))

    def call():  # type: ignore[no-untyped-def]
        return [fit(x, y, told) for x, y in zip(told["x"], told["y"], strict=True)]

    found = call()
    np.savez(f"{file}.fitted", theta=[each.x for each in found], evaluations=[each.nfev for each in found])
    return call


def _search(objective, told):  # type: ignore[no-untyped-def]
    """The least negative log evidence, searched for as in gp/fit.py; flat priors add a constant to what is compared
    with the tolerance."""
    import numpy as np
    from scipy.optimize import minimize

    def with_constant(theta):  # type: ignore[no-untyped-def]
        value, slope = objective(theta)
        return value + told["constant"], slope

    options = {"maxiter": int(told["iterations"]), "ftol": 1e-9, "gtol": 1e-5}
    start, bounds = np.log(told["start"]), np.log(told["bounds"])
    return minimize(with_constant, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)


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
    found = globals()[f"{what}_{name}"](where if what in ("predict", "fit") else int(where))
    if what != "serve":
        answer(found)
