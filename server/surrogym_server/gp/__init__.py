"""Gaussian process regression of one output at a time, in float64. All symbols: docs/glossary.md.

========  ======================  =========================================================
paper     code                    meaning
========  ======================  =========================================================
x~        ``x`` (..., d)          input of the process: encoded coordinates and action
Lambda    ``lengthscale`` (d,)    Lambda = diag(lengthscale ** -2)
sigma_f^2 ``signal_variance``     variance of the squared-exponential part
--        ``linear_variance``     variance of the linear part, 0 without one
--        ``quadratic_variance``  variance of the quadratic part, 0 without one
sigma_n^2 ``noise_variance``      variance of the noise, added to the diagonal of K
K         ``covariance(x, x)``    covariance of the function values, without noise
s, p      ``Reflection``          signs and parity, if all functions have f(s x) = p f(x)
beta      ``weights`` (n,)        (K + sigma_n^2 I)^-1 y
========  ======================  =========================================================
"""

from surrogym_server.gp.fit import Fitted, fit, fit_some, noisy_explanation, refine, refine_where_hard
from surrogym_server.gp.growth import fit_growing
from surrogym_server.gp.hyperparameter_samples import hyperparameter_samples
from surrogym_server.gp.joint_posterior import Joint
from surrogym_server.gp.kernel import Hyperparameters, Reflection, covariance
from surrogym_server.gp.parameters import MOST_NOISE, NOISE_FLOOR, FitOptions
from surrogym_server.gp.pathwise import Pathwise
from surrogym_server.gp.pooling import Part, Pool, pools
from surrogym_server.gp.posterior import LeftOut, Posterior, Sparse, condition
from surrogym_server.gp.selection import Selection, select_inputs
from surrogym_server.gp.serving import Output, Serving
from surrogym_server.gp.sparse import Censored, condition_many, condition_sparse
from surrogym_server.gp.subsets import spread
from surrogym_server.gp.variational_bound import (
    Fewer,
    fewer_inputs,
    fit_bound,
    fit_through_few,
    is_noisy,
    loses_nothing,
)

__all__ = [
    "MOST_NOISE",
    "NOISE_FLOOR",
    "Censored",
    "Fewer",
    "FitOptions",
    "Fitted",
    "Hyperparameters",
    "Joint",
    "LeftOut",
    "Output",
    "Part",
    "Pathwise",
    "Pool",
    "Posterior",
    "Reflection",
    "Selection",
    "Serving",
    "Sparse",
    "condition",
    "condition_many",
    "condition_sparse",
    "covariance",
    "fewer_inputs",
    "fit",
    "fit_bound",
    "fit_growing",
    "fit_some",
    "fit_through_few",
    "hyperparameter_samples",
    "is_noisy",
    "loses_nothing",
    "noisy_explanation",
    "pools",
    "refine",
    "refine_where_hard",
    "select_inputs",
    "spread",
]
