"""Order of the trials of a table: neighbouring rows whose residuals are alike are not independent."""

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.series import autocorrelation
from capsule_id.inference.checks.regression import design
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.views import Finding

#: Family-wise false-alarm rate over the tables, and smallest correlation that counts: it widens the sd by a fifth.
ORDER_LEVEL, SMALLEST_CORRELATION = 0.005, 0.2
#: Number of permutations; above so many rows the correlation is normal with variance 1/n.
PERMUTATIONS, MANY_ROWS = 10_000, 200
#: Fewest rows that can be judged: 6 rows have 720 orders.
FEWEST_ROWS = 6
#: Residuals below this share of the noise, rms, are rounding, and their order means nothing.
SMALLEST_SCATTER = 0.02


def check_order(s: SampledFit) -> list[Finding]:
    """Check that residuals of neighbouring rows are uncorrelated (permutation test of the lag-1 correlation)."""
    findings, tables = [], []
    for e in s.experiments:
        if e.time_series:
            continue
        residuals, columns = design(e, e.local(s.values))
        # An outlier shifts the fit; without it the residuals are those of the local fit to the other rows.
        if flagged := s.flagged.get(e.label, []):
            residuals, columns = np.delete(residuals, flagged), np.delete(columns, flagged, axis=0)
            residuals = residuals - columns @ np.linalg.lstsq(columns, residuals, rcond=None)[0]
        if len(residuals) >= FEWEST_ROWS and np.std(residuals) > SMALLEST_SCATTER:
            tables.append((e, residuals))
    for e, residuals in tables:
        correlation, p = lag_1(residuals)
        if correlation > SMALLEST_CORRELATION and p * len(tables) < ORDER_LEVEL:
            factor = np.sqrt((1.0 + correlation) / (1.0 - correlation))
            facts = {"correlation": correlation, "rows": len(residuals), "p": p, "factor": float(factor)}
            findings.append(Finding("trials.order", "fail", facts, e.label))
    return findings or [Finding("trials.order", "ok", {"number": len(tables)})] * bool(tables)


def lag_1(residuals: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Lag-1 correlation of residuals (n,) and the probability that a random order gives as large a one."""
    correlation = float(autocorrelation(residuals, 1)[0])
    n = len(residuals)
    if n > MANY_ROWS:
        return correlation, float(stats.norm.sf(correlation * np.sqrt(n)))
    shuffled = np.random.default_rng(seed).permuted(np.tile(residuals - np.mean(residuals), (PERMUTATIONS, 1)), axis=1)
    random = np.sum(shuffled[:, 1:] * shuffled[:, :-1], axis=1) / np.sum(shuffled**2, axis=1)
    return correlation, float((1 + np.sum(random >= correlation - 1e-12)) / (1 + PERMUTATIONS))
