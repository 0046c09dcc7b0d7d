"""Profile likelihoods of parameters, and a word for what the readings know of each of them.

The profile of a parameter is the log-posterior without its own prior, maximised over all other parameters at each value
(Raue et al., *Bioinformatics* 25, 2009, 1923). The others keep their priors: a weighing is a reading.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import linalg, stats

from capsule_id.errors import InputError
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.point_fit import polish, root_of_covariance
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import is_stated
from capsule_id.views import ResultTable

#: Values on either side of the best one, and their reach in posterior standard deviations.
VALUES, REACH = 8, 4.0
#: A profile that falls by this much has reached the end of its 95 % interval.
DROP = 0.5 * float(stats.chi2.ppf(0.95, 1))
#: A parameter with a smaller ratio of posterior to prior sd, and a smaller sd of its logarithm, is bounded without a profile.
NARROW_RATIO, NARROW_SD = 0.3, 0.3
#: Steps of a short profile on either side.
SHORT = 2
#: Correlation from which a parameter is tied to another one.
TIED = 0.95


def profile(target: LogPosterior, fit: PointFit, name: str, values: int = VALUES) -> pd.DataFrame:
    """Profile of one parameter from ``REACH`` sd below the best value to ``REACH`` sd above, ``values`` on either side.

    Returns
    -------
    DataFrame with the columns ``value`` (SI, ascending), ``profile`` (less its largest value), ``curvature`` (the parabola
    of the point fit's curvature), and the values of the other physical parameters where the maximum is.

    Raises
    ------
    InputError
        If the parameter is not sampled.
    """
    check_profiled(target, [name])
    return _profiles(target, fit, [name], values)[name]


def check_profiled(target: LogPosterior, names: Sequence[str]) -> None:
    """Refuse names of parameters that are not sampled."""
    for name in names:
        if name not in target.names:
            raise InputError("a profile needs a parameter of the fit", name, f"choose from {', '.join(target.names)}")


def _profiles(target: LogPosterior, fit: PointFit, names: Sequence[str], values: int) -> dict[str, pd.DataFrame]:
    """Profiles by name. Every value starts from its neighbour's maximum, moved along the ridge that the curvature has."""
    root = np.matmul(*root_of_covariance(target, fit.u, linearised(target, fit.u)[1])) if names else np.empty((0, 0))
    found = {}
    for name in names:
        i = target.names.index(name)
        sd = float(np.linalg.norm(root[i]))
        ridge, across = root @ root[i] / sd**2, root @ linalg.null_space(root[i : i + 1])
        across[i] = 0.0
        points = [(fit.u, float(np.max(fit.log_posterior)))]
        for side in (-1.0, 1.0):
            here = fit.u
            for _ in range(values):
                start = here + side * REACH / values * sd * ridge
                here, height, _ = polish(target, start, (across, np.eye(across.shape[1])))
                points.append((here, height))
        points.sort(key=lambda point: point[0][i])
        u, heights = np.stack([here for here, _ in points]), np.array([height for _, height in points])
        theta = target.theta(u)
        likelihood = heights - target.priors.at(slice(None), np).terms(u, theta, np)[:, i]
        z = (u[:, i] - fit.u[i]) / sd
        columns = {"value": theta[:, i], "profile": likelihood - np.max(likelihood), "curvature": -0.5 * z**2}
        others = {row.name: theta[:, j] for j, row in enumerate(target.parameters) if row.physical and j != i}
        found[name] = pd.DataFrame({**columns, **others})
    return found


def _end(value: np.ndarray, height: np.ndarray) -> str:
    """Where a profile first falls by ``DROP``, from its top on; open where it does not."""
    if not np.any(below := height < -DROP):
        return "open"
    near = [int(np.argmax(below)), int(np.argmax(below)) - 1]
    return f"{np.interp(-DROP, height[near], value[near]):.5g}"


def profile_tables(target: LogPosterior, fit: PointFit, names: Sequence[str]) -> list[ResultTable]:
    """A table of the report for each profiled parameter; see ``profile``."""
    tables = []
    for name in dict.fromkeys(names):
        frame = profile(target, fit, name)
        value, height = frame["value"].to_numpy(), frame["profile"].to_numpy()
        top = int(np.argmax(height))
        sides = slice(top, None, -1), slice(top, None)
        ends = [_end(value[side], height[side]) for side in sides]
        row = target.parameters[target.names.index(name)]
        facts = {"name": name, "unit": row.unit, "lower": ends[0], "upper": ends[1], "drop": DROP}
        tables.append(ResultTable("parameters.profile", frame.set_index("value"), facts))
    return tables


def identified(target: LogPosterior, fit: PointFit) -> list[ResultTable]:
    """The table of words, a row for each physical parameter that is not stated; [] where there are none.

    ``bounded``: the profile falls on both sides; ``upper limit`` and ``lower limit``: on one side alone; ``flat``: on
    none, so that the prior decides. ``tied to``: a parameter of which only a combination with this one is known better.
    Motions of the capsule take long: where there are runs the curvature stands for the profiles.
    """
    names = [row.name for row in target.parameters if row.physical and not is_stated(row.name)]
    variance = np.diag(fit.covariance)
    if not names or not np.all(np.isfinite(variance) & (variance > 0.0)):
        return []
    sd, place = np.sqrt(variance), [target.names.index(name) for name in names]
    ratio = sd / target.prior_sd
    quick = target.kinked or any(e.event_driven for e in target.experiments)
    narrow = (ratio <= NARROW_RATIO) & (~target.positive | (sd <= NARROW_SD))
    open_ = [name for name, i in zip(names, place, strict=True) if not (narrow[i] or quick)]
    profiles = _profiles(target, fit, open_, SHORT)
    ends = {name: profiles[name]["profile"].to_numpy() <= -DROP for name in profiles}
    table = words_of(target.names, fit.covariance, ratio, {name: (bool(x[0]), bool(x[-1])) for name, x in ends.items()})
    return [ResultTable("parameters.identified", table.loc[names].round(4))]


def words_of(
    names: Sequence[str], covariance: np.ndarray, ratio: np.ndarray, ends: Mapping[str, tuple[bool, bool]] | None = None
) -> pd.DataFrame:
    """The rows of ``identified`` by name; ``ratio`` (d,): sd over prior sd; ``ends``: where a profile falls, below and above.

    Without a profile the precision of the posterior less that of the prior decides.
    """
    sd, rows = np.sqrt(np.diag(covariance)), {}
    correlation = covariance / np.outer(sd, sd) - np.eye(len(sd))
    bounded = 0.5 * REACH**2 * (1.0 - ratio**2) >= DROP
    for i, name in enumerate(names):
        low, high = (ends or {}).get(name, (bool(bounded[i]), bool(bounded[i])))
        word = "bounded" if low and high else "upper limit" if high else "lower limit" if low else "flat"
        partner = int(np.argmax(np.abs(correlation[i])))
        tied = f", tied to {names[partner]}" if abs(correlation[i, partner]) >= TIED else ""
        rows[name] = {
            "known": word + tied,
            "correlation": correlation[i, partner],
            "with": names[partner],
            "sd / prior sd": ratio[i],
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")
