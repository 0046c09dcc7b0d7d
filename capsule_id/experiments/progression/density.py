"""Density of the trials of a progression: sessions, runs, and sums over the trials of one setting."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.special as jax_special
import numpy as np
import scipy.special as scipy_special
from jaxtyping import Float, Int
from numpy.polynomial.hermite_e import hermegauss

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.misfit import LOG_2PI, Misfit
from capsule_id.experiments.progression.declaration import SESSIONS, alternatives
from capsule_id.physics.batches import array_module, pool
from capsule_id.records.tones import VISIBLE

# sessions: Sessions of a progression: how the friction of each one enters, and the runs of the capsule that follow.
#
# Session j has friction multiplied by exp(session_sd z_j), z_j ~ N(0, 1). Where it has several settings, z_j is a
# parameter; at most eight sessions are. All others are integrated out, in each of their settings alone, with a
# motion that is piecewise linear in z_j between runs. There are more runs where the setting has several of these
# sessions, because they determine z_j apart from the discrepancy, also far from 0.


#: z beyond which a session has no weight.
FAR = 1e3
#: z of the runs of a session that is integrated out. One that has its setting for itself has the inner ones only. The
#: outer lines go on beyond their runs.
NODES = 1.25 * np.arange(-2.0, 3.0)
INNER, MIDDLE = slice(1, -1), 2


class Sessions(eqx.Module):
    """Cases, each a setting in a session, and their runs, in the order of the cases.

    Attributes
    ----------
    rows : (n, cases) 1 where a trial belongs to a case
    setting : (cases,) index of its setting
    alone : (cases,) 1 where z is integrated out
    columns : (cases, lone) 1 where a case is the one of these that has this number
    shared : (cases,) 1 where z of another session of the setting is integrated out too
    at : (cases, nodes) index of the run at each of ``NODES``, or of the nearest one
    case, node : (runs,) index of the case; z of a session that is integrated out, else 0
    own : (runs, parameters) 1 where z is this parameter
    """

    rows: np.ndarray
    setting: np.ndarray
    alone: np.ndarray
    columns: np.ndarray
    shared: np.ndarray
    at: np.ndarray
    case: np.ndarray
    node: np.ndarray
    own: np.ndarray

    def __init__(
        self,
        setting: Float[np.ndarray, "n settings"],
        session: Float[np.ndarray, "n sessions"],
        parameter: Int[np.ndarray, " sessions"],
    ) -> None:
        """Cases of trials with these memberships, see ``parameters_of`` for ``parameter``."""
        trials = np.stack([np.argmax(setting, axis=1), np.argmax(session, axis=1)], axis=1)
        cases, case = np.unique(trials, axis=0, return_inverse=True)
        of = parameter[cases[:, 1]]
        alone = of < 0
        shared = alone & (np.bincount(cases[:, 0], weights=alone)[cases[:, 0]] > 1.0)
        self.rows, self.setting = np.eye(len(cases))[case], cases[:, 0]
        self.alone, self.columns, self.shared = 1.0 * alone, np.eye(len(cases))[:, alone], 1.0 * shared
        kept = np.arange(len(NODES))
        nodes = [
            kept if many else kept[INNER] if one else kept[[MIDDLE]] for one, many in zip(alone, shared, strict=True)
        ]
        runs = np.array(list(map(len, nodes)))
        self.case, self.node = np.repeat(np.arange(len(cases)), runs), NODES[np.concatenate(nodes)]
        self.at = (np.cumsum(runs) - runs)[:, None] + np.array(
            [np.clip(kept - own[0], 0, len(own) - 1) for own in nodes]
        )
        self.own = 1.0 * (of[self.case][:, None] == np.arange(1 + int(np.max(parameter))))

    @property
    def symbols(self) -> tuple[str, ...]:
        """Of the parameters z."""
        return tuple(row.symbol for row in SESSIONS[: self.own.shape[1]])

    def log_friction(self, theta: ValuesBySymbol) -> Any:
        """(runs,) logarithm of what multiplies the friction; (draws, runs) where theta has (draws, 1) each."""
        z = sum((theta[symbol] * own for symbol, own in zip(self.symbols, self.own.T, strict=True)), self.node)
        return theta["session_sd"] * z

    @property
    def setting_of_run(self) -> Any:
        """(runs,) index of the setting of each run."""
        return _index(self.setting)[_index(self.case)]

    def responses(self, X2: Any) -> Any:
        """(..., cases, nodes) X2 of every case at ``NODES``, from (..., runs): beyond the outer runs linear."""
        xp = array_module(X2, self.shared)
        X = xp.asarray(X2)[..., _index(self.at)]
        outer = xp.stack([2.0 * X[..., 1] - X[..., 2], 2.0 * X[..., 3] - X[..., 2]], axis=-1)
        beyond = xp.concatenate([outer[..., :1], X[..., INNER], outer[..., 1:]], axis=-1)
        return xp.where((self.shared > 0.0).reshape(*(1,) * (X.ndim - 2), -1, 1), X, beyond)


def _index(numbers: Any) -> Any:
    # The log-posterior stores all numbers of experiments as floats.
    return array_module(numbers).asarray(numbers).astype(int)


def lines(X: Any, nodes: np.ndarray, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """(..., lines) value at z = 0 and slope of the lines between X (..., nodes)."""
    z = xp.asarray(nodes.reshape(*(1,) * (X.ndim - 1), -1))
    slope = (X[..., 1:] - X[..., :-1]) / (z[..., 1:] - z[..., :-1])
    return X[..., 1:] - slope * z[..., 1:], slope


def edges(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(lines,) z where each line begins and ends; the outer ones go on."""
    return np.append(-FAR, nodes[1:-1]), np.append(nodes[1:-1], FAR)


def parameters_of(
    setting: Float[np.ndarray, "n settings"], session: Float[np.ndarray, "n sessions"]
) -> Int[np.ndarray, " sessions"]:
    """Index of the parameter of each session, -1 where it is integrated out, in each of its settings alone.

    Sessions with several settings have parameters, at most as many as there are ``SESSIONS``: those with most settings.
    """
    settings = np.sum((session.T @ setting) > 0.0, axis=1)
    most = np.argsort(-settings, kind="stable")[: len(SESSIONS)]
    chosen = np.sort(most[settings[most] > 1])
    found = np.full(len(settings), -1)
    found[chosen] = np.arange(len(chosen))
    return found


# emulator: Emulator of the motions of an experiment: a smooth function of its parameters, fitted to exact motions.
#
# Ridge regression on random Fourier features (A. Rahimi, B. Recht, *Random features for large-scale kernel machines*,
# Advances in Neural Information Processing Systems 20, 2007, 1177). It approximates Gaussian-process regression with a
# Matérn kernel of smoothness 5/2. The sampler uses it for proposals only; exact motions decide on every one of them.


#: Number of features, correlation length in sds of the training inputs, and ridge penalty of a weight.
FEATURES, LENGTH, RIDGE = 2000, 8.0, 1e-3
#: Coefficients of the series of a cosine in the square.
COSINE = [(-1.0) ** k / math.factorial(2 * k) for k in range(10)]
#: Rows of a block of the normal equations.
ROWS = 2048
#: Degrees of freedom of the random frequencies: twice the smoothness of the kernel.
FREEDOM = 5.0


class Emulator(eqx.Module):
    """Motions (k,) as a function of parameters (p,) by symbol.

    Attributes
    ----------
    symbols, positive : (p,) inputs; positive ones enter by their logarithms
    centre, scale : (p,) mean and sd of the training inputs
    frequencies, phases : (p, features) and (features,)
    weights : (features + 1 + p, k)
    """

    symbols: tuple[str, ...] = eqx.field(static=True)
    positive: tuple[bool, ...] = eqx.field(static=True)
    centre: np.ndarray
    scale: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray
    weights: np.ndarray

    def __init__(
        self, positive: Mapping[str, bool], draws: Sequence[Mapping[str, Any]], motions: Float[np.ndarray, "n k"]
    ) -> None:
        """Fit to the ``motions`` at ``draws``; rows that are not finite are left out.

        Parameters
        ----------
        positive : inputs by symbol, and whether each is positive
        """
        self.symbols, self.positive = tuple(positive), tuple(positive.values())
        x = self._inputs({symbol: np.array([draw[symbol] for draw in draws], float) for symbol in positive}, np).T
        known = np.all(np.isfinite(motions), axis=1)
        x, y = x[known], motions[known]
        self.centre, self.scale = np.mean(x, axis=0), np.std(x, axis=0)
        rng = np.random.default_rng(0)
        spread = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, FEATURES)) / LENGTH
        self.frequencies = spread * rng.standard_normal((x.shape[1], FEATURES))
        self.phases = rng.uniform(0.0, 2.0 * np.pi, FEATURES)
        size = FEATURES + 1 + x.shape[1]
        square, product = RIDGE * np.eye(size), np.zeros((size, y.shape[1]))
        for i in range(0, len(x), ROWS):  # all rows at once would need gigabytes
            f = self._features(x[i : i + ROWS], np)
            square += f.T @ f
            product += f.T @ y[i : i + ROWS]
        self.weights = np.linalg.solve(square, product)

    def __call__(self, theta: Mapping[str, Any]) -> Any:
        """Motions (k,) at parameters by symbol, () each."""
        return (self._features(self._inputs(theta, jnp)[None], jnp) @ self.weights)[0]

    def _inputs(self, theta: Mapping[str, Any], xp: Any) -> Any:
        """(p, ...) of parameters by symbol, (...) each."""
        pairs = zip(self.symbols, self.positive, strict=True)
        return xp.stack(
            [xp.log(theta[symbol]) if positive else xp.asarray(theta[symbol]) for symbol, positive in pairs]
        )

    def _features(self, x: Any, xp: Any) -> Any:
        """(n, features + 1 + p): cosines, 1 and scaled inputs, of the inputs ``x`` (n, p)."""
        z = (x - self.centre[None]) / self.scale[None]
        waves = _cosine(z @ self.frequencies + self.phases[None], xp)
        return xp.concatenate([waves, xp.ones((len(z), 1)), z], axis=1)


def _cosine(x: Any, xp: Any) -> Any:
    """Cosine of x (...) within 1e-8, by its series; XLA's own takes ten times as long on a CPU."""
    turns = x / (2.0 * np.pi)
    square = (2.0 * np.pi * (turns - xp.round(turns))) ** 2
    found = COSINE[-1] * xp.ones_like(square)
    for coefficient in COSINE[-2::-1]:
        found = found * square + coefficient
    return found


# run emulator: Emulator of the runs of a progression.


class RunEmulator(eqx.Module):
    """One emulator of the runs of each session that is a parameter, and one of all others.

    A run depends on the friction of its own session alone, and inputs without effect make an emulator less accurate.

    Attributes
    ----------
    symbols : of the parameters of sessions
    parts : the emulators that are needed
    place : (runs,) place of each run among the outputs of ``parts``
    """

    symbols: tuple[str, ...] = eqx.field(static=True)
    parts: tuple[Emulator, ...]
    place: np.ndarray

    def __init__(
        self,
        sessions: Sessions,
        positive: Mapping[str, bool],
        draws: Sequence[ValuesBySymbol],
        motions: Float[np.ndarray, "n runs"],
    ) -> None:
        """Fit to the ``motions`` at ``draws``; ``positive``: parameters of the motion, and whether each is positive."""
        self.symbols = sessions.symbols
        groups = [
            ({**positive, "session_sd": True}, np.all(sessions.own == 0.0, axis=1)),
            *(({**positive, name: False}, sessions.own[:, j] > 0.0) for j, name in enumerate(self.symbols)),
        ]
        groups = [(inputs, np.flatnonzero(own)) for inputs, own in groups if np.any(own)]
        known = [self._inputs(draw) for draw in draws]
        self.parts = tuple(pool().map(lambda group: Emulator(group[0], known, motions[:, group[1]]), groups))
        self.place = np.argsort(np.concatenate([own for _, own in groups]))

    def __call__(self, theta: ValuesBySymbol) -> Any:
        """(runs,) motions at parameters by symbol, () each."""
        inputs = self._inputs(theta)
        return jnp.concatenate([part(inputs) for part in self.parts])[jnp.asarray(self.place).astype(int)]

    def _inputs(self, theta: ValuesBySymbol) -> dict[str, Any]:
        """Sessions enter by the logarithm of their friction."""
        return {**theta, **{symbol: theta["session_sd"] * theta[symbol] for symbol in self.symbols}}


# groups: Density of the trials of a progression from sums over cases: the trials of one setting in one session.
#
# Trials of a case differ only by their own scatter, so their number, mean and spread are sufficient. Given the
# parameters, settings are independent. The discrepancy of a setting is integrated out in closed form, and so is the
# session of a case that has none as a parameter: its motion is piecewise linear in z. Where a setting has several of
# these, they share its discrepancy, which is integrated by Gauss-Hermite quadrature about a normal approximation.
#
# With heavy tails a setting has an alternative for every choice of its outlying trials, see
# ``capsule_id.experiments.progression.declaration``, and its density is their sum. Without, it has one.


#: Nodes of the discrepancy of a setting with several sessions that are integrated out. Errors are below 0.01 where it is
#: up to 3 sds of the mean of a case, and reach 2 at 10 sds where a motion is flat on one side of a kink and steep beyond.
DISCREPANCIES = 13
#: Groups of cases: of a known session, and of sessions that are integrated out, see ``TrialGroups.members``.
KNOWN, LONE, SHARED = range(3)


class TrialGroups(eqx.Module):
    """Cases of trials by alternative: those whose session is known, and those whose session is integrated out.

    Attributes
    ----------
    variance : (alternatives, n) of every trial relative to the usual one; its inverse is the weight of a trial
    log_share : (alternatives,) logarithm of the prior probability within the setting
    setting : (alternatives,) index of the setting, in ascending order
    case : (k,) case of the trials, as in ``Sessions``; an alternative has all cases of its setting
    sums : (5, k) weighted mean, m, number of trials, sum of their weights, sum of squares, m^2, sum of the logarithms of
        ``variance``
    members : index of those whose session is known, of the others that are alone in their setting, apart from known
        ones, and of those that share it
    of_alternative : for each of ``members``, (k, alternatives) 1 where it belongs to an alternative
    """

    variance: np.ndarray
    log_share: np.ndarray
    setting: np.ndarray
    case: np.ndarray
    sums: np.ndarray
    members: tuple[np.ndarray, ...]
    of_alternative: tuple[np.ndarray, ...]

    def __init__(self, distance: Float[np.ndarray, " n"], sessions: Sessions, heavy: bool = False) -> None:
        """Group trials by their distance, m."""
        settings = 1 + int(np.max(sessions.setting))
        membership = sessions.rows @ np.eye(settings)[sessions.setting]
        self.variance, self.log_share, self.setting = alternatives(membership, heavy)
        alternative, self.case = np.nonzero(self.setting[:, None] == sessions.setting)
        rows, weight = sessions.rows.T[self.case], 1.0 / self.variance[alternative]
        count, measure = np.sum(rows * weight, axis=1), np.sum(rows * np.log(self.variance[alternative]), axis=1)
        mean = np.sum(rows * weight * distance, axis=1) / count
        spread = np.sum(rows * weight * (distance - mean[:, None]) ** 2, axis=1)
        self.sums = np.stack([mean, np.sum(rows, axis=1), count, spread, measure])
        alone, shared = sessions.alone[self.case], sessions.shared[self.case]
        self.members = tuple(np.flatnonzero(own) for own in (alone == 0.0, alone > shared, shared))
        each = np.arange(len(self.setting))
        self.of_alternative = tuple(1.0 * (alternative[own][:, None] == each) for own in self.members)


@dataclass(frozen=True)
class TrialMisfit:
    """Trials against their model, at any value of ``trial_sd``.

    Attributes
    ----------
    X2 : (cases, nodes) displacements at z = ``NODES``, m; where z is a parameter, the middle one counts
    reading_variance, trial_scatter : variance of a reading, m^2, and relative scatter of a trial
    discrepancy : (settings,) its standard deviation, m
    """

    groups: TrialGroups
    X2: Any
    reading_variance: float
    trial_scatter: Any
    discrepancy: Any

    def log_density(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the trials at ``scatter`` (...), m; (...)."""
        return xp.sum(self.of_settings(scatter, xp), axis=-1)

    def of_settings(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """(..., settings) that of the trials of each setting, at ``scatter`` (...), m."""
        scatter, groups = xp.asarray(scatter), self.groups
        found = self.of_alternatives(scatter.reshape(-1), xp)
        if len(groups.log_share) > len(self.discrepancy):
            member = xp.arange(len(self.discrepancy))[:, None] == xp.asarray(groups.setting)[None]
            special = scipy_special if xp is np else jax_special
            found = special.logsumexp(xp.where(member[None], found[:, None], -xp.inf), axis=2)
        return found.reshape(*scatter.shape, -1)

    def of_alternatives(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """(scatter, alternatives) density of the trials and prior probability of each, at ``scatter`` (scatter,), m."""
        groups, flat = self.groups, scatter.reshape(-1, 1)
        # Axes: scatter and case, then scatter and alternative.
        X2, y, trials, count, spread, measure, owner = self._cases(KNOWN, xp)
        v = self.reading_variance + (self.trial_scatter * X2[None, :, MIDDLE]) ** 2 + flat**2
        weight, y = count[None] / v, (y - X2[:, MIDDLE])[None]
        inside = trials[None] * (LOG_2PI + xp.log(v)) + spread[None] / v + measure[None] + weight * y**2
        # What the discrepancy explains of the trials of known friction, and its normal density given these.
        of_setting = xp.asarray(groups.setting).astype(int)
        prior, moment = (xp.asarray(self.discrepancy)[of_setting] ** 2)[None], (weight * y) @ owner
        gain = 1.0 + prior * (weight @ owner)
        variance = prior / gain
        density = -0.5 * (inside @ owner - variance * moment**2 + xp.log(gain))
        for member in (LONE, SHARED):
            if len(groups.members[member]):
                density = density + self._of_lone_sessions(member, flat[..., None], (variance * moment, variance), xp)
        return density + xp.asarray(groups.log_share)[None]

    def linear(self, distance: np.ndarray, sessions: Sessions, scatter: Any, xp: ModuleType = jnp) -> Misfit:
        """Misfit of the trials, linear about the most probable friction of each session, at ``scatter``, m.

        With heavy tails the outlying trials are those of the most probable alternative of each setting.

        Parameters
        ----------
        distance : (n,) of the trials, m
        """
        rows, columns = xp.asarray(sessions.rows), xp.asarray(sessions.columns)
        setting = xp.asarray(sessions.setting).astype(int)
        usual = self._relative_variance(rows, setting, scatter, xp)
        start, slope, expected = self._most_probable_lines(distance, rows, setting, 1.0 / usual, scatter, xp)
        own = setting[:, None] == xp.arange(len(self.discrepancy))[None]
        discrepancy = xp.asarray(self.discrepancy)[None] * (rows @ own)
        design = xp.concatenate([(rows @ columns) * (slope @ columns)[None], discrepancy], axis=1)
        variance = self.reading_variance + (self.trial_scatter * (rows @ expected)) ** 2
        return Misfit(distance - rows @ start, usual * variance, xp.sqrt(usual), design)

    def _relative_variance(self, rows: Any, setting: Any, scatter: Any, xp: ModuleType) -> Any:
        """(n,) variance of each trial relative to the usual one, in the most probable alternative of its setting."""
        groups = self.groups
        if len(groups.log_share) == len(self.discrepancy):
            return xp.ones(len(rows))
        density = self.of_alternatives(xp.asarray(scatter).reshape(1), xp)[0]
        own = rows @ (setting[:, None] == xp.asarray(groups.setting)[None])
        best = xp.argmax(xp.where(own > 0.0, density[None], -xp.inf), axis=1)
        return xp.take_along_axis(xp.asarray(groups.variance), best[None], axis=0)[0]

    def _most_probable_lines(
        self, distance: np.ndarray, rows: Any, setting: Any, weight: Any, scatter: Any, xp: ModuleType
    ) -> tuple[Any, ...]:
        """(cases,) value at z = 0 and slope of the line with the most probable z, and its displacement there, m.

        The slope is 0 where this z is at a kink: no small change of it explains more.

        Parameters
        ----------
        weight : (n,) of each trial
        """
        X2 = xp.asarray(self.X2)
        start, slope = lines(X2, NODES, xp)
        count = weight @ rows
        r = ((weight * distance) @ rows / count)[:, None] - start
        variance = self.reading_variance + (self.trial_scatter * X2[:, MIDDLE, None]) ** 2 + scatter**2
        w = variance / count[:, None] + (xp.asarray(self.discrepancy)[setting] ** 2)[:, None]
        low, high = (xp.asarray(edge[None]) for edge in edges(NODES))
        z = xp.clip(slope * r / (w + slope**2), low, high)
        best = xp.argmin(z**2 + (r - slope * z) ** 2 / w, axis=1)[:, None]
        expected, inside = start + slope * z, (z > low) & (z < high)
        found = xp.where(inside, start, expected), xp.where(inside, slope, 0.0), expected
        return tuple(xp.take_along_axis(x, best, axis=1)[:, 0] for x in found)

    def _cases(self, member: int, xp: ModuleType) -> tuple[Any, ...]:
        """``X2`` (k, nodes), mean, number, sum of weights, spread, measure (k,) and alternatives of a group of cases."""
        # The log-posterior stores all numbers of experiments as floats.
        index, case = (xp.asarray(x).astype(int) for x in (self.groups.members[member], self.groups.case))
        owner = xp.asarray(self.groups.of_alternative[member])
        return self.X2[case[index]], *xp.asarray(self.groups.sums)[:, index], owner

    def _of_lone_sessions(self, member: int, scatter: Any, discrepancy: tuple[Any, Any], xp: ModuleType) -> Any:
        """(scatter, alternatives) density of the trials whose z is integrated out.

        The variance of a trial is taken where its line is nearest to the mean of the trials, at usual z.

        Parameters
        ----------
        member : ``LONE`` for cases that have a setting for themselves, ``SHARED`` for those that share it
        scatter : (scatter, 1, 1) m
        discrepancy : (scatter, alternatives) its mean, m, and variance, m^2, given the trials of known friction
        """
        special, shared = scipy_special if xp is np else jax_special, member == SHARED
        nodes, chosen = (NODES, slice(None)) if shared else (NODES[INNER], INNER)
        X2, y, trials, count, spread, measure, owner = self._cases(member, xp)
        start, slope = lines(X2[:, chosen], nodes, xp)
        low, high = (start + slope * np.clip(z, -VISIBLE, VISIBLE)[None] for z in edges(nodes))
        nearest = xp.clip(y[:, None], xp.minimum(low, high), xp.maximum(low, high))
        # Axes: scatter, case, line, discrepancy.
        v = (self.reading_variance + (self.trial_scatter * nearest[None]) ** 2 + scatter**2)[..., None]
        start, slope = (x[None, ..., None] for x in (start, slope))
        y, trials, count, spread, measure = (x[None, :, None, None] for x in (y, trials, count, spread, measure))
        mean, variance = ((x @ owner.T)[..., None, None] for x in discrepancy)
        at, weights = hermegauss(DISCREPANCIES if shared else 1)
        t, correction = xp.zeros((1, 1, 1, 1)), xp.zeros((1, 1, 1))
        if shared:
            t, correction = self._discrepancies(X2, scatter, discrepancy, at, xp)
            t = xp.einsum("kbd,cb->kcd", t, owner)[:, :, None]
        r = y - start - (mean + xp.sqrt(variance) * t)
        # One case of a setting has the variance of the discrepancy in closed form.
        w = v / count + (0.0 if shared else variance)
        total = w + slope**2
        inside = (trials - 1.0) * (LOG_2PI + xp.log(v)) + xp.log(count) + measure + spread / v
        # Given the readings and its line, z is normal; the part of it that belongs to the line counts.
        z, precision = slope * r / total, xp.sqrt(total / w)
        lower, upper = ((edge.reshape(1, 1, -1, 1) - z) * precision for edge in edges(nodes))
        part = _log_probability(lower, upper, special, xp)
        cases = special.logsumexp(part - 0.5 * (inside + LOG_2PI + xp.log(total) + r**2 / total), axis=2)
        log_weights = correction + np.log(weights / np.sum(weights)).reshape(1, 1, -1)
        found = xp.einsum("kcd,cb->kbd", cases, owner)
        return special.logsumexp(found + log_weights, axis=2)

    def _discrepancies(
        self, X2: Any, scatter: Any, discrepancy: tuple[Any, Any], at: np.ndarray, xp: ModuleType
    ) -> tuple[Any, Any]:
        """(scatter, alternatives, d) discrepancies in sds from their mean, and logarithms of the factors of their weights.

        The nodes ``at`` lie about a normal approximation: each motion is taken as linear between the inner runs.
        """
        _, y, _, count, *_, owner = self._cases(SHARED, xp)
        X2 = X2.reshape(1, *X2.shape)
        slope = (X2[..., INNER][..., -1] - X2[..., INNER][..., 0]) / (NODES[INNER][-1] - NODES[INNER][0])
        v = self.reading_variance + (self.trial_scatter * X2[..., MIDDLE]) ** 2 + scatter[..., 0] ** 2
        q = 1.0 / (v / count[None] + slope**2)
        mean, variance = discrepancy
        r = y[None] - X2[..., MIDDLE] - mean @ owner.T
        gain = 1.0 + variance * (q @ owner)
        centre = xp.sqrt(variance) * ((q * r) @ owner) / gain
        u = at.reshape(1, 1, -1)
        t = centre[..., None] + u / xp.sqrt(gain)[..., None]
        return t, 0.5 * (u**2 - t**2 - xp.log(gain)[..., None])


def _log_probability(lower: Any, upper: Any, special: ModuleType, xp: ModuleType) -> Any:
    """Logarithm of the standard normal probability between ``lower`` and ``upper``, which differ by 1 or more."""
    right = lower > 0.0
    near, far = xp.where(right, lower, -upper), xp.where(right, upper, -lower)
    first = special.log_ndtr(-near)
    return first + xp.log1p(-xp.exp(special.log_ndtr(-far) - first))
