"""The depth filter's model without its approximation: the posterior of (inverse depth, inlier ratio) on a grid.

The posterior is kept as weights of cells; every measurement multiplies them with the likelihood
π N(x; ξ, τ²) + (1 - π)/z_range. Nothing is assumed about its shape.
"""

import numpy as np
from scipy.stats import beta, norm


def posterior(mu, variance, a, b, xs, taus, z_range, *, around, half_width, cells=1201, ratios=101):
    """Mean and σ of the inverse depth and mean of the inlier ratio after each of the measurements.

    The grid has a coarse part over the whole prior and a fine one of `cells` over `around` ± `half_width`.
    """
    sigma = np.sqrt(variance)
    coarse = np.linspace(mu - 6 * sigma, mu + 6 * sigma, 501)
    fine = np.linspace(around - half_width, around + half_width, cells)
    xi = np.unique(np.concatenate([coarse, fine]))
    width = np.gradient(xi)
    pi = (np.arange(ratios) + 0.5) / ratios
    log = (norm.logpdf(xi, mu, sigma) + np.log(width))[:, None] + beta.logpdf(pi, a, b)[None, :]
    out = []
    for x, tau in zip(xs, taus, strict=True):
        good = norm.pdf(x, xi, tau)
        log = log + np.log(good[:, None] * pi[None, :] + (1 - pi)[None, :] / z_range)
        w = np.exp(log - log.max())
        w /= w.sum()
        px, pp = w.sum(1), w.sum(0)
        mean = px @ xi
        out.append((mean, np.sqrt(px @ (xi - mean) ** 2), pp @ pi))
    return np.array(out)


def stream(rng, count, outliers, z_range, *, tau_first=0.066, growing=True):
    """Inverse depths measured from ever wider baselines: truth, measurements, τ, which are good.

    A camera of 420 px that flies 27 mm a frame at 1.5 m height has τ = 0.066 z_range at the first frame and 1/k of it
    at the k-th. Bad measurements are uniform over z_range, as the model has it.
    """
    true = z_range * rng.uniform(0.25, 0.75)
    tau = z_range * tau_first / (np.arange(1, count + 1) if growing else np.full(count, 10.0))
    good = rng.random(count) >= outliers
    x = np.where(good, true + tau * rng.standard_normal(count), rng.uniform(0, z_range, count))
    return true, x, tau, good
