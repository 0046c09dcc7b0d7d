"""Expected log predictive density of settings left out, by Pareto-smoothed importance sampling (PSIS-LOO).

Draws of a density near the posterior are weighted by the posterior: of the emulated posterior where there is one, else
independent draws of the sampler's adapted proposal. Division by the density of the readings of a setting, given the
parameters and all other readings, leaves the setting out.
(A. Vehtari, A. Gelman, J. Gabry, *Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC*,
Statistics and Computing 27, 2017, 1413.)
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capsule_id.experiments.families.trials_experiment import TrialsExperiment
from capsule_id.inference.choice.importance import LARGEST_SHAPE, log_evidence, smoothed_weights
from capsule_id.inference.result import PointFit
from capsule_id.inference.sampling.emulation import Emulation, ExactMotions, emulation
from capsule_id.inference.sampling.ensembles import adapted_proposal, laplace_proposal
from capsule_id.inference.sampling.proposal import BlockProposal
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior, trials_of

#: Draws of a proposal; draws of an emulated posterior, fewer because their weights vary less.
DRAWS, EMULATED_DRAWS = 4096, 2048
#: Largest number of adaptations of the proposal without a setting, each from the one before.
ADAPTATIONS = 3
#: Weight that draws without a density may hold.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class WeightedDraws:
    """Draws of a density near a posterior.

    Attributes
    ----------
    target, fit : posterior, and the point fit that the adaptation began with
    drawn_from : the adapted proposal, or the emulated posterior
    log_weight : (n, blocks) log of posterior over the density drawn from, each block of parameters; -inf outside
    log_normalisation : (2, blocks) log of the integral of the density drawn from, and its standard error; 0 for a proposal
    block : block of each parameter by name
    inside, values : indices (m,) of the draws inside the posterior, and their values by name
    """

    target: LogPosterior
    fit: PointFit
    drawn_from: BlockProposal | Emulation
    log_weight: np.ndarray
    log_normalisation: np.ndarray
    block: Mapping[str, int]
    inside: np.ndarray
    values: list[dict[str, float]]

    def of(self, e: TrialsExperiment) -> Float[np.ndarray, " m"]:
        """Log-weights of the block that ``e`` depends on."""
        return self.log_weight[
            self.inside, next(self.block[row.name] for row in e.parameters if row.name in self.block)
        ]


@dataclass(frozen=True)
class LeftOut:
    """One setting left out.

    Attributes
    ----------
    density : log predictive density of its readings given all others
    shape : Pareto shape of the weights
    log_weight : (m,) of ``draws``, smoothed, normalised
    """

    density: float
    shape: float
    log_weight: np.ndarray
    draws: WeightedDraws


def weighted_draws(
    target: LogPosterior,
    fit: PointFit,
    seed: int,
    first: BlockProposal | None = None,
    known: ExactMotions | None = None,
) -> WeightedDraws:
    """Draws of a density near ``target``.

    Parameters
    ----------
    first : proposal that is adapted to a similar posterior; default: the adaptation begins with the Laplace approximation
    known : exact motions near the posterior, where it can be emulated
    """
    marginal, random = MarginalPosterior(target, fit), np.random.RandomState(seed)
    if marginal.can_be_emulated:
        laplace, large = laplace_proposal(marginal)
        drawn_from = emulation(marginal, first or laplace, large, random, known)
        v = drawn_from.draw(EMULATED_DRAWS, random)
        log_weight = marginal.parts(v) - drawn_from.target.parts(v)
        log_normalisation = _log_normalisation(drawn_from, random)
    else:
        drawn_from = adapted_proposal(marginal, random, first)
        v, density = _known_draws(drawn_from, random)
        log_weight, log_normalisation = marginal.parts(v) - density, np.zeros((2, len(marginal.blocks)))
    inside = np.flatnonzero(np.all(np.isfinite(log_weight), axis=1))
    u, _ = marginal.restore(v[inside], seed)
    located = np.flatnonzero(~target.integrated)
    label = {target.names[i]: k for k, block in enumerate(marginal.blocks) for i in located[block]}
    values = [target.mapping(theta) for theta in target.theta(u)]
    return WeightedDraws(target, fit, drawn_from, log_weight, log_normalisation, label, inside, values)


def _known_draws(proposal: BlockProposal, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """``DRAWS`` draws (w, d) and their log-densities (w, blocks); +inf where a block has overflowed, at another place."""
    v = proposal.draw(random, DRAWS)
    known = np.stack([np.all(np.isfinite(v[:, block]), axis=1) for block in proposal.blocks], axis=1)
    v = np.where(np.isfinite(v), v, np.nanmean(v, axis=0))
    return v, np.where(known, proposal.log_density(v), np.inf)


def _log_normalisation(emulated: Emulation, random: np.random.RandomState) -> np.ndarray:
    """(2, blocks) log-evidence of an emulated posterior and its standard error."""
    v, density = _known_draws(emulated.proposal, random)
    rng = np.random.default_rng(random.randint(2**31))
    return np.array([log_evidence(block, rng) for block in (emulated.target.parts(v) - density).T]).T


def leave_settings_out(e: TrialsExperiment, draws: WeightedDraws) -> list[LeftOut]:
    """Leave out every setting of ``e`` in turn."""
    density = e.densities_of_settings([e.local(values) for values in draws.values])
    return [_left_out(draws.of(e), one, draws, -1.0) for one in density.T]


def leave_setting_out(draws: WeightedDraws, e: TrialsExperiment, setting: int, seed: int) -> LeftOut:
    """Leave out one setting of ``e`` by draws of the posterior without it.

    The density drawn from is adapted further, up to ``ADAPTATIONS`` times, while the shape is too large.
    """
    target, (first, known) = draws.target, _without(draws, e, setting)
    experiments = [e.without(setting) if each is e else each for each in target.experiments]
    smaller = LogPosterior(target.rig, experiments)
    tried = list[LeftOut]()
    while len(tried) < ADAPTATIONS and not any(one.shape <= LARGEST_SHAPE for one in tried):
        left = weighted_draws(smaller, draws.fit, seed, first, known)
        density = e.densities_of_settings([e.local(values) for values in left.values])[:, setting]
        tried.append(_left_out(left.of(e), density, left, 0.0))
        first, known = _adapted(left.drawn_from)
    return min(tried, key=lambda one: one.shape)


def _adapted(drawn_from: BlockProposal | Emulation) -> tuple[BlockProposal, ExactMotions | None]:
    """What the next adaptation begins with."""
    return (drawn_from.proposal, drawn_from.known) if isinstance(drawn_from, Emulation) else (drawn_from, None)


def _without(draws: WeightedDraws, e: TrialsExperiment, setting: int) -> tuple[BlockProposal, ExactMotions | None]:
    """What the adaptation to the posterior without one setting begins with."""
    first, known = _adapted(draws.drawn_from)
    if known is None:
        return first, None
    pairs = zip(trials_of(draws.target), known.motions, strict=True)
    return first, ExactMotions(known.v, [e.motions_without(own, setting) if one is e else own for one, own in pairs])


def _left_out(log_weight: np.ndarray, density: np.ndarray, draws: WeightedDraws, power: float) -> LeftOut:
    """Multiply the weights by ``density`` to a power, and smooth them.

    A draw without a density lies far outside the posterior and has weight 0. Where such draws hold weight before, the
    shape is infinite: the density of the setting is not known.
    """
    known, smoothed = np.isfinite(density), np.full(len(density), -np.inf)
    if not np.any(known):
        return LeftOut(-np.inf, np.inf, smoothed, draws)
    smoothed[known], shape = smoothed_weights(log_weight[known] + power * density[known])
    lost = np.logaddexp.reduce(log_weight[~known]) - np.logaddexp.reduce(log_weight) if not np.all(known) else -np.inf
    return LeftOut(
        float(np.logaddexp.reduce(smoothed[known] + density[known])),
        shape if lost < np.log(NEGLIGIBLE) else np.inf,
        smoothed,
        draws,
    )
