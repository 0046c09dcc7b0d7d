"""The sampled physical parameters as columns, in display units: what corner plot and traces have in common."""

from dataclasses import dataclass

import numpy as np

from capsule_id.inference.result import Posterior, Result
from capsule_id.report.columns import magnitude
from capsule_id.report.typography import plain_symbol, prefix_for


@dataclass(frozen=True)
class SampledParameters:
    """Sampled physical parameters, nuisances left out.

    Attributes
    ----------
    names : (n,) as in the summary
    symbols, units : (n,) for display
    draws : (ensemble, draw, walker, n) in display units
    map, paper : (n,) point fit and the paper's estimate (NaN where it has none), display units
    """

    names: tuple[str, ...]
    symbols: tuple[str, ...]
    units: tuple[str, ...]
    draws: np.ndarray
    map: np.ndarray
    paper: np.ndarray
    posterior: Posterior


def sampled_parameters(result: Result) -> SampledParameters:
    """The columns of ``result``.

    Raises
    ------
    ValueError
        If nothing was sampled.
    """
    if result.posterior is None:
        raise ValueError("nothing was sampled (point fit only): fit without --no-sample (budget=None)")
    place = {name: i for i, name in enumerate(result.posterior.names)}
    summary = result.summary.loc[[name in place for name in result.summary.index]]
    names = tuple(str(name) for name in summary.index)
    display = [prefix_for(str(row["unit"]), magnitude(row)) for row in summary.to_dict("records")]
    scale = np.array([factor for factor, _ in display])
    return SampledParameters(
        names=names,
        symbols=tuple(plain_symbol(name) for name in names),
        units=tuple(unit for _, unit in display),
        draws=result.posterior.draws[..., [place[name] for name in names]] * scale,
        map=summary["map"].to_numpy(float) * scale,
        paper=summary["paper"].to_numpy(float) * scale,
        posterior=result.posterior,
    )
