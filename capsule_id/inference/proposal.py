"""Proposals of the sampler: coordinates, mixtures, triangular maps, and their adaptation by rounds of weighted draws."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln, log_ndtr, ndtr, ndtri

from capsule_id.inference.curvature import Matrix, PerPoint, Points, Random, Vector

# coordinates: Coordinates w of the proposals of a block of parameters, and the priors of terms that may be absent.
#
# Most parameters are proposed in u, the logarithm of a positive parameter. Two terms that replace each other, as
# viscous and dry damping do, lie on a line in theta, which is bent in u: they are proposed in theta.
#
# A term that the readings hardly show may be absent. The tail of its u towards minus infinity is as long as that of
# its prior, so that some proposals draw this u from its prior. Other parameters change with its theta, so that w
# leaves this change out.


#: Smallest sd of u of a parameter that may be proposed in theta, and of one that may be absent. Below these sds u and
#: theta are in proportion, and the readings exclude zero.
BENT, WEAK = 0.05, 0.2
#: Largest numbers of such parameters of a block.
MOST_BENT, MOST_WEAK = 6, 5
#: Draws from a prior end this far above the largest u of a sample, in sds of u.
MARGIN = 0.5


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a block of d parameters.

    Attributes
    ----------
    linear : (d,) whether w is theta; else it is u
    weak : indices of the parameters that may be absent
    centre, width : (d,) of the normal priors of u; used for ``weak`` only
    upper : (d,) largest u drawn from these priors
    shear : (d, d) change of a parameter that is not weak with the theta of one that is: w leaves it out
    """

    linear: Bool[np.ndarray, " d"]
    weak: tuple[int, ...]
    centre: Vector
    width: Vector
    upper: Vector
    shear: Matrix

    def w(self, u: Points) -> Points:
        return np.where(self.linear, np.exp(np.where(self.linear, u, 0.0)), u) - self._weak_part(u)

    def u(self, w: Points) -> Points:
        """NaN where theta is not positive."""
        w = w + self._weak_part(self._unsheared(w))
        return self._unsheared(w)

    def _unsheared(self, w: Points) -> Points:
        """u of coordinates without the part of the weak parameters; that of a weak parameter is 0."""
        positive = self.linear & (w > 0.0)
        logarithm = np.where(positive, np.log(np.where(positive, w, 1.0)), np.nan)
        return np.where(self.linear, logarithm, w)

    def _weak_part(self, u: Points) -> Points:
        """Part of each parameter that changes with the theta of the weak ones; constant above ``upper``."""
        weak = list(self.weak)
        return np.exp(np.minimum(u, self.upper)[:, weak]) @ self.shear[:, weak].T

    def prior_density(self, u: Points) -> Points:
        """Log-densities of the priors, which end at ``upper``."""
        z, highest = (u - self.centre) / self.width, (self.upper - self.centre) / self.width
        density = -0.5 * z**2 - np.log(self.width * np.sqrt(2.0 * np.pi)) - log_ndtr(highest)
        return np.where(z <= highest, density, -np.inf)

    def draw_prior(self, rng: Random, size: int) -> Points:
        """u of every parameter from its prior."""
        share = ndtr((self.upper - self.centre) / self.width)
        return self.centre + self.width * ndtri(rng.uniform(size=(size, len(self.centre))) * share)


def logarithmic(dimension: int) -> Coordinates:
    """w = u, and no parameter that may be absent."""
    zero = np.zeros(dimension)
    return Coordinates(np.zeros(dimension, dtype=bool), (), zero, zero + 1.0, zero, np.zeros((dimension, dimension)))


def coordinates_of(sample: Points, prior: Float[np.ndarray, "2 d"]) -> Coordinates:
    """Coordinates in which a ``sample`` of u is closest to normal: largest likelihood of a normal density (Box & Cox).

    Parameters
    ----------
    prior : centre and width of the normal prior of u; NaN for a parameter with another prior
    """
    sd, normal = np.std(sample, axis=0), np.all(np.isfinite(prior), axis=0)
    by_sd = sorted(np.flatnonzero(normal), key=lambda i: -sd[i])
    bent = [i for i in by_sd if sd[i] > BENT][:MOST_BENT]
    weak = [int(i) for i in by_sd if sd[i] > WEAK][:MOST_WEAK]
    both = np.concatenate([sample, np.exp(sample[:, bent])], axis=1)
    owners = np.concatenate([np.arange(len(sd)), np.array(bent, dtype=int)])
    shear = _shear(both, sample[:, weak])
    shear[np.isin(owners, weak)] = 0.0
    sheared = both - np.exp(sample[:, weak]) @ shear.T
    scale = np.std(sheared, axis=0)
    covariance, best = np.atleast_2d(np.cov((sheared / scale).T)), (-np.inf, np.arange(len(sd)))
    for chosen in product((False, True), repeat=len(bent)):
        index = np.arange(len(sd))
        index[bent] = np.where(chosen, len(sd) + np.arange(len(bent)), bent)
        # The Jacobian of theta, on average over the sample.
        stretch = np.sum(np.mean(sample[:, bent], axis=0), where=np.array(chosen, dtype=bool))
        size = np.sum(np.log(scale[index]))
        likelihood = stretch - size - 0.5 * np.linalg.slogdet(covariance[np.ix_(index, index)])[1]
        if likelihood > best[0]:
            best = likelihood, index
    centre, width = np.where(normal, prior, [[0.0], [1.0]])
    slopes = np.zeros((len(sd), len(sd)))
    slopes[:, weak] = shear[best[1]]
    upper = np.max(sample, axis=0) + MARGIN * sd
    return Coordinates(best[1] >= len(sd), tuple(weak), centre, width, upper, slopes)


def _shear(values: Float[np.ndarray, "n k"], weak: Float[np.ndarray, "n weak"]) -> Float[np.ndarray, "k weak"]:
    """Slopes of ``values`` on exp(weak), beside their slopes on ``weak``.

    Two terms that replace each other lie on a line in theta even where the prior of one has its tail in u.
    """
    known = np.column_stack([np.exp(weak), weak, np.ones(len(weak))])
    size = np.linalg.norm(known, axis=0)
    slopes = np.linalg.lstsq(known / size, values, rcond=None)[0] / size[:, None]
    return slopes[: weak.shape[1]].T


# proposal: Proposals of independence steps: one density for each block of parameters, as a mixture of Student
# densities.


#: Degrees of freedom of wide and of narrow proposals, and scales of their components with the weights. Few trials give
#: heavy tails. A forced run determines many correlated parameters well: a wider proposal is almost never accepted there.
WIDE, NARROW = (6.0, (1.0, 2.0, 4.0)), (200.0, (1.0, 1.15, 1.4))
WEIGHTS = np.array([0.85, 0.1, 0.05])
#: Share of proposals that draw parameters that may be absent from their priors, and the largest number of these at once.
FROM_PRIOR, MOST_DRAWN = 0.4, 2


class Mixture:
    """Student densities of several scales about one centre in the coordinates w of d parameters.

    Some components draw parameters that may be absent from their priors, and the others given these.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d) of w; the covariance is a squared scale
    narrow : whether the tails are light
    coordinates : by default u

    Attributes
    ----------
    weights : (k,) of the components: of each subset of parameters that are drawn from their priors, the scales
    """

    def __init__(
        self, centre: Vector, covariance: Matrix, narrow: bool = False, coordinates: Coordinates | None = None
    ) -> None:
        self._freedom, scales = NARROW if narrow else WIDE
        self._centre, self._coordinates = centre, coordinates or logarithmic(len(centre))
        weak = self._coordinates.weak
        subsets = [subset for number in range(MOST_DRAWN + 1) for subset in combinations(weak, number)]
        shares = np.full(len(subsets), FROM_PRIOR / max(len(subsets) - 1, 1))
        shares[0] = 1.0 - np.sum(shares[1:])
        self.weights, self._scales = np.outer(shares, WEIGHTS).ravel(), np.array(scales)
        self._subsets = np.array([np.isin(np.arange(len(centre)), own) for own in subsets])
        self._slopes, self._roots = (
            np.stack(each) for each in zip(*(_given(covariance, own) for own in self._subsets), strict=True)
        )
        self._inverses = np.linalg.inv(self._roots)
        freedom, d = self._freedom, np.sum(~self._subsets, axis=1)
        size = np.sum(np.log(np.diagonal(self._roots, axis1=1, axis2=2)), axis=1)
        constant = gammaln(0.5 * (freedom + d)) - gammaln(0.5 * freedom) - 0.5 * d * np.log(np.pi * freedom) - size
        self._power = 0.5 * (freedom + d)
        constants = constant[:, None] - d[:, None] * np.log(self._scales)
        self._constant = np.log(self.weights).reshape(constants.shape) + constants

    def components(self, u: Points) -> Float[np.ndarray, "k n"]:
        """Log-densities of u under the components, weights included."""
        # Components of one subset differ in their scale alone.
        off = np.broadcast_to(self._coordinates.w(u) - self._centre, (len(self._subsets), *u.shape))
        kept = ~self._subsets[:, None]
        if len(self._subsets) > 1:
            off = np.where(kept, off - off @ self._slopes.transpose(0, 2, 1), 0.0)
        square = np.sum((off @ self._inverses.transpose(0, 2, 1)) ** 2, axis=2)
        square = square[:, None] / (self._freedom * self._scales[:, None] ** 2)
        student = self._constant[..., None] - self._power[:, None, None] * np.log1p(square)
        # log |dw/du| is u for a parameter in theta.
        others = np.sum(np.where(self._coordinates.linear & kept, u, 0.0), axis=2)
        others += np.sum(np.where(kept, 0.0, self._coordinates.prior_density(u)), axis=2)
        return np.reshape(student + others[:, None], (len(self.weights), len(u)))

    def log_density(self, u: Points) -> PerPoint:
        with np.errstate(over="ignore"):  # far out squares overflow, and the density is 0
            return np.logaddexp.reduce(self.components(u), axis=0)

    def draw(self, rng: Random, size: int) -> Points:
        """Draw u; NaN where theta is not positive."""
        k, scale = np.divmod(rng.choice(len(self.weights), size=size, p=self.weights), len(self._scales))
        scale = self._scales[scale] * np.sqrt(self._freedom / rng.chisquare(self._freedom, size))
        noise = scale[:, None] * rng.standard_normal((size, len(self._centre)))
        drawn, coordinates, known = self._subsets[k], self._coordinates, np.zeros_like(noise)
        if coordinates.weak:
            known = np.where(drawn, coordinates.w(coordinates.draw_prior(rng, size)) - self._centre, 0.0)
        noise = np.where(drawn, 0.0, noise)
        left = (self._slopes[k] @ known[:, :, None] + self._roots[k] @ noise[:, :, None])[:, :, 0]
        return coordinates.u(self._centre + known + left)


def _given(covariance: Matrix, drawn: Bool[np.ndarray, " d"]) -> tuple[Matrix, Matrix]:
    """Slope of the other parameters on those ``drawn``, and root of the covariance that is left; unit root for those."""
    slope, root, rest = np.zeros_like(covariance), np.eye(len(covariance)), ~drawn
    across = covariance[np.ix_(rest, drawn)]
    own = np.linalg.solve(covariance[np.ix_(drawn, drawn)], across.T).T
    slope[np.ix_(rest, drawn)] = own
    root[np.ix_(rest, rest)] = np.linalg.cholesky(covariance[np.ix_(rest, rest)] - own @ across.T)
    return slope, root


@dataclass(frozen=True)
class BlockProposal:
    """One proposal for each block.

    Attributes
    ----------
    blocks : indices of the parameters of each block; together all parameters
    """

    blocks: Sequence[np.ndarray]
    densities: "Sequence[Mixture | Transported]"

    def log_density(self, u: Points) -> Float[np.ndarray, "n blocks"]:
        """Log-density of the parameters of each block."""
        pairs = zip(self.blocks, self.densities, strict=True)
        return np.stack([density.log_density(u[:, block]) for block, density in pairs], axis=1)

    def draw(self, rng: Random, size: int) -> Points:
        """Draw u; NaN for a parameter in theta that is not positive."""
        u = np.empty((size, sum(map(len, self.blocks))))
        for block, density in zip(self.blocks, self.densities, strict=True):
            u[:, block] = density.draw(rng, size)
        return u

    def draw_inside(
        self, rng: Random, size: int, instead: Points | None = None
    ) -> tuple[Points, Bool[np.ndarray, "n blocks"]]:
        """Draw u, and whether the parameters of each block have a value; those without one are at other places.

        Parameters
        ----------
        instead : (size, d) of the other places; by default the mean of the draws
        """
        u = self.draw(rng, size)
        inside = np.stack([np.all(np.isfinite(u[:, block]), axis=1) for block in self.blocks], axis=1)
        return np.where(np.isfinite(u), u, np.nanmean(u, axis=0) if instead is None else instead), inside


def block_proposal(
    blocks: Sequence[np.ndarray], centre: Vector, covariance: Matrix, narrow: Sequence[bool] | None = None
) -> BlockProposal:
    """Mixtures in u for all blocks.

    Parameters
    ----------
    centre, covariance : (d,) and (d, d), of which only the blocks are used
    narrow : for each block whether its proposals are narrow; None: all are wide
    """
    flags = narrow or [False] * len(blocks)
    pairs = zip(blocks, flags, strict=True)
    return BlockProposal(blocks, [Mixture(centre[b], covariance[np.ix_(b, b)], flag) for b, flag in pairs])


# transport: Proposals of a bent posterior: a triangular map to coordinates that are nearly normal (Parno & Marzouk
# 2018).
#
# The posterior of a robot's friction, force and lag is bent in twelve dimensions. Components of a mixture follow
# that badly; a quadratic mean and a linear logarithmic scale of each coordinate, given those before it, follow it
# well. Normal scores come first: the logarithm of a scatter that may be zero has a long tail.


#: Parameters of the largest block with a map: the time of its least squares grows with their fourth power.
LARGEST_MAP = 15
#: The map follows coordinates up to this many sds from their mean; beyond, it stays the same.
FARTHEST = 3.0
#: Ridge penalty of the coefficients times the effective sample size: coefficients below 0.2 sd are shrunk.
SHRINKAGE = 30.0
#: Outermost normal score with a knot, number of knots (odd), and distance of a further knot on either side relative to it.
OUTER, KNOTS, FAR = 2.5, 11, 2.0
#: Scores of this effective number of draws or fewer are linear; of more draws, in proportion less.
SMOOTHED = 50.0
#: Indices of the products of two coordinates; a chain asks for those of a few dimensions at each of its steps.
PAIRS = cache(np.triu_indices)
#: Newton steps for the scales, and the share of each step that is taken.
MAP_STEPS, SHARE = 30, 0.7


class Scores:
    """Normal scores of each parameter: a piecewise linear function, straight beyond its outer knots.

    Parameters
    ----------
    u, weights : (n, d) draws and their normalised weights
    """

    def __init__(self, u: Points, weights: PerPoint) -> None:
        share = min(SMOOTHED * float(np.sum(weights**2)), 1.0)
        score = np.linspace(-OUTER, OUTER, KNOTS)
        quantiles = np.stack([np.quantile(x, ndtr(score), weights=weights, method="inverted_cdf") for x in u.T])
        mean = np.average(u, axis=0, weights=weights)
        sd = np.sqrt(np.average((u - mean) ** 2, axis=0, weights=weights))
        inner = (1.0 - share) * quantiles + share * (mean[:, None] + sd[:, None] * score)
        # Beyond the outer knots lie few draws: the slope there is that between them and the median.
        beyond = (inner[:, [0, -1]] - inner[:, [KNOTS // 2]]) * FAR
        self._knots = np.concatenate([inner[:, :1] + beyond[:, :1], inner, inner[:, -1:] + beyond[:, 1:]], axis=1)
        ends = np.array([-(1.0 + FAR) * OUTER, (1.0 + FAR) * OUTER])
        self._score = np.broadcast_to(np.concatenate([ends[:1], score, ends[1:]]), self._knots.shape)

    def scores(self, u: Points) -> tuple[Points, PerPoint]:
        """Scores, and the log of their Jacobian."""
        found, slope = _straight(u, self._knots, self._score)
        return found, np.sum(np.log(slope), axis=1)

    def u(self, scores: Points) -> Points:
        return _straight(scores, self._score, self._knots)[0]


class Transported:
    """Student densities of coordinates x that a triangular map makes of the normal scores s of d parameters u.

    With z = (s - mean) / root, x_i = (z_i - b_i . f(z_1 ... z_i-1)) exp(-g_i . h(z_1 ... z_i-1)); f holds 1, z and the products
    of two z, h holds 1 and z.

    Parameters
    ----------
    u, weights : (n, d) draws and their normalised weights, which determine the map
    """

    def __init__(self, u: Points, weights: PerPoint) -> None:
        self._scores = Scores(u, weights)
        s, _ = self._scores.scores(u)
        self._mean, covariance = np.average(s, axis=0, weights=weights), np.atleast_2d(np.cov(s.T, aweights=weights))
        self._root = np.linalg.cholesky(covariance)
        z, ridge = self._z(s), SHRINKAGE * np.sum(weights**2)
        d = z.shape[1]
        # Columns: 1, the coordinates and their products, of which a coordinate uses those before it.
        self._means, self._scales = np.zeros((1 + d + len(PAIRS(d)[0]), d)), np.zeros((1 + d, d))
        self._own = [np.flatnonzero(np.concatenate([[True], np.arange(d) < i, PAIRS(d)[1] < i])) for i in range(d)]
        quadratic, linear = _quadratic(z), _linear(z)
        for i, own in enumerate(self._own):
            f, h = quadratic[:, own], linear[:, : 1 + i]
            weighted = f.T * weights
            self._means[own, i] = np.linalg.solve(weighted @ f + ridge * np.eye(len(own)), weighted @ z[:, i])
            self._scales[: 1 + i, i] = _log_scale(h, z[:, i] - f @ self._means[own, i], weights, ridge)
        x, _ = self._x(u)
        self._mixture = Mixture(np.average(x, axis=0, weights=weights), np.atleast_2d(np.cov(x.T, aweights=weights)))

    def _z(self, s: Points) -> Points:
        return np.linalg.solve(self._root, (s - self._mean).T).T

    def _x(self, u: Points) -> tuple[Points, PerPoint]:
        """Coordinates x, and log |dx/du|."""
        s, logarithm = self._scores.scores(u)
        z = self._z(s)
        size = _linear(z) @ self._scales
        x = (z - _quadratic(z) @ self._means) * np.exp(-size)
        return x, logarithm - np.sum(np.log(np.diag(self._root))) - np.sum(size, axis=1)

    def log_density(self, u: Points) -> PerPoint:
        x, logarithm = self._x(u)
        return self._mixture.log_density(x) + logarithm

    def draw(self, rng: Random, size: int) -> Points:
        x = self._mixture.draw(rng, size)
        z = np.empty_like(x)
        for i, own in enumerate(self._own):
            f, h = _quadratic(z[:, :i]), _linear(z[:, :i])
            z[:, i] = f @ self._means[own, i] + x[:, i] * np.exp(h @ self._scales[: 1 + i, i])
        return self._scores.u(self._mean + z @ self._root.T)


def _straight(x: Points, knots: Float[np.ndarray, "d k"], values: Float[np.ndarray, "d k"]) -> tuple[Points, Points]:
    """Piecewise linear function of each coordinate that has ``values`` at ``knots``, and its slope; straight beyond them."""
    i = np.sum(x[:, :, None] > knots[None, :, 1:-1], axis=2)
    j = np.arange(x.shape[1])[None]
    slope = (np.diff(values, axis=1) / np.diff(knots, axis=1))[j, i]
    return values[j, i] + slope * (x - knots[j, i]), slope


def _linear(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1 and the coordinates, which end at ``FARTHEST``."""
    return np.column_stack([np.ones(len(z)), np.clip(z, -FARTHEST, FARTHEST)])


def _quadratic(z: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n k"]:
    """1, the coordinates and their products of two."""
    first, second = PAIRS(z.shape[1])
    near = _linear(z)
    return np.column_stack([near, near[:, 1 + first] * near[:, 1 + second]])


def _log_scale(
    h: Float[np.ndarray, "n k"], residuals: PerPoint, weights: PerPoint, ridge: float
) -> Float[np.ndarray, " k"]:
    """Coefficients of the logarithm of the sd of ``residuals``: largest likelihood of normal residuals."""
    found = np.zeros(h.shape[1])
    found[0] = 0.5 * np.log(np.sum(weights * residuals**2))
    penalty: Matrix = ridge * np.eye(len(found))
    for _ in range(MAP_STEPS):
        square = weights * residuals**2 * np.exp(-2.0 * (h @ found))
        slope = h.T @ (square - weights) - penalty @ (found - np.eye(len(found))[0] * found[0])
        found = found + SHARE * np.linalg.solve(2.0 * (h.T * square) @ h + penalty, slope)
    return found


# refinement: Adapt a proposal to the posterior by adaptive multiple importance sampling (Cornuet et al. 2012), before
# any chain.
#
# A short chain from the Laplace approximation misses tails where the width of the posterior depends on one
# parameter, as on the correlation time of noise, or where two terms replace each other, as viscous and dry damping
# do. Weighted draws from a wide proposal find them. Each round draws from the mixture of the round before. The
# draws of all rounds are weighted by the mean of the densities of all rounds. They determine the next proposal: one
# centre in the coordinates of the block; a triangular map in a large block, and where one centre does not suffice.


#: Message where the sampler has no point to start from.
NO_MASS = "no finite log-posterior near the point fit: the Laplace approximation does not hold there"
#: Draws of a round, rounds with one centre, and largest number of rounds, the later ones with maps.
DRAWS, SINGLE, ROUNDS = 2048, 4, 16
#: Rounds with maps where an evaluation takes long.
FEWER = 2
#: Rounds end where the effective sample size of every block is this share of the draws of a round: after all rounds with
#: one centre, and before. Early rounds may miss a tail, and their effective sample size does not show it. A large
#: block keeps its first proposal above the first share where it is too large for a map, above the second otherwise: a
#: scatter that may be zero has a tail that the Laplace approximation does not reach.
ENOUGH, EXCELLENT = 0.3, 0.6
#: Weights are tempered, w^a, where their effective sample size is below this number per parameter; exponents a to try.
LEAST_SIZE, TEMPERS = 20.0, 0.8 ** np.arange(30)
#: Fewest draws per parameter that determine a covariance.
FEWEST = 2


class _Rounds:
    """Draws of one block of d parameters in all rounds, and the proposal that each round drew from."""

    def __init__(self, first: Mixture | Transported, prior: Float[np.ndarray, "2 d"], large: bool) -> None:
        self.proposals, self._prior, self._large = [first], prior, large
        self._u = np.empty((0, prior.shape[1]))
        self._log_posterior = self._log_drawn = np.empty(0)

    def add(self, u: Points, log_posterior: PerPoint) -> float:
        """Add the draws of the newest proposal; return their effective sample size.

        Raises
        ------
        RuntimeError
            If no draw of any round has a finite log-posterior.
        """
        densities = [proposal.log_density(u) for proposal in self.proposals]
        earlier = np.logaddexp(self._log_drawn, self.proposals[-1].log_density(self._u))
        self._u = np.concatenate([self._u, u])
        self._log_posterior = np.concatenate([self._log_posterior, log_posterior])
        self._log_drawn = np.concatenate([earlier, np.logaddexp.reduce(densities, axis=0)])
        if not np.any(np.isfinite(self._log_posterior)):
            raise RuntimeError(NO_MASS)
        if not np.any(np.isfinite(log_posterior)):
            return 0.0
        return effective_size(log_posterior - densities[-1])

    @property
    def log_weights(self) -> PerPoint:
        """Logarithms of the weights of the draws of all rounds, without a common constant."""
        return self._log_posterior - self._log_drawn

    def next(self, good: bool, rng: Random) -> None:
        """Add the proposal of the next round: the same where it is ``good``, else that which all draws determine.

        It also stays where few draws have a density: those of more rounds together determine the next one.
        """
        self.proposals.append(self.proposals[-1] if good else self._adapted(rng))

    def _adapted(self, rng: Random) -> Mixture | Transported:
        weights = tempered(self.log_weights, LEAST_SIZE * self._u.shape[1])
        used = weights > 0.0  # the theta of the others may overflow
        u, weights = self._u[used], weights[used]
        if len(u) < FEWEST * u.shape[1]:
            return self.proposals[-1]
        if u.shape[1] <= LARGEST_MAP and (self._large or len(self.proposals) > SINGLE):
            return Transported(u, weights)
        coordinates = coordinates_of(u[rng.choice(len(u), len(u), p=weights)], self._prior)
        w = coordinates.w(u)
        covariance = np.atleast_2d(np.cov(w.T, aweights=weights))
        return Mixture(np.average(w, axis=0, weights=weights), covariance, coordinates=coordinates)


def refined(
    parts: Callable[[np.ndarray], np.ndarray],
    first: BlockProposal,
    prior: Float[np.ndarray, "2 d"],
    rng: Random,
    large: Sequence[bool],
    rounds: int | None = None,
) -> BlockProposal:
    """Proposal adapted to a posterior, from the proposal ``first``.

    Parameters
    ----------
    parts : (n, d) -> (n, blocks), log-densities of the blocks
    prior : centre and width of the normal prior of u; NaN for a parameter with another prior
    large : for each block whether its first proposal stays where it is good enough; where it is not, a block of at most
        ``LARGEST_MAP`` parameters gets a map at once, others after ``SINGLE`` rounds
    rounds : largest number of rounds, by default ``ROUNDS``

    Raises
    ------
    RuntimeError
        If no draw has a finite log-density.
    """
    pairs = zip(first.blocks, first.densities, large, strict=True)
    blocks = [_Rounds(mixture, prior[:, block], own) for block, mixture, own in pairs]
    proposal = first
    for i in range(rounds or ROUNDS):
        u, inside = proposal.draw_inside(rng, DRAWS)
        found = parts(u)
        log_parts = np.where(inside & ~np.isnan(found), found, -np.inf)
        good = list[bool]()
        for j, own in enumerate(blocks):
            size = own.add(u[:, first.blocks[j]], log_parts[:, j])
            late = i >= SINGLE or (i == 0 and len(first.blocks[j]) > LARGEST_MAP)
            # The first proposal of a small block never stays.
            good.append((i > 0 or large[j]) and size >= (ENOUGH if late else EXCELLENT) * DRAWS)
            own.next(good[j], rng)
        if all(good):
            break
        # The newest proposal knows the draws of all rounds, so that it misses the fewest tails.
        proposal = BlockProposal(first.blocks, [own.proposals[-1] for own in blocks])
    return proposal


def affordable_rounds(evaluations: float) -> int:
    """Largest number of rounds for about so many ``evaluations``, ``FEWER`` of them with maps at least."""
    return int(np.clip(evaluations / DRAWS, SINGLE + FEWER, ROUNDS))


def effective_size(log_weights: PerPoint) -> float:
    """Effective sample size of weights, 1/sum of their squares where their sum is 1."""
    weights = np.exp(log_weights - np.max(log_weights))
    return float(np.sum(weights) ** 2 / np.sum(weights**2))


def tempered(log_weights: PerPoint, least: float) -> PerPoint:
    """Normalised weights to the largest power of ``TEMPERS`` whose effective sample size is at least ``least``.

    Where there is none, the largest weights count alike and the others not at all (Koblents & Míguez 2015).
    """
    powers = [a for a in TEMPERS if effective_size(a * log_weights) >= least]
    if powers:
        weights = np.exp(powers[0] * (log_weights - np.max(log_weights)))
    else:
        number = min(int(np.ceil(least)), len(log_weights))
        best = log_weights >= np.partition(log_weights, -number)[-number]
        weights = np.asarray(best & np.isfinite(log_weights), dtype=float)
    return weights / np.sum(weights)
