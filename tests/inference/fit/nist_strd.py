"""Thirteen certified problems: NIST StRD (Statistical Reference Datasets), Nonlinear Regression, public domain.

National Institute of Standards and Technology, "Statistical Reference Datasets: Nonlinear Regression",
itl.nist.gov/div898/strd/nls. Numbers as printed there: data, both starting points, certified estimates with their
standard deviations and residual sum of squares (11 digits, computed by NIST in 128-bit arithmetic by two programs).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from capsule_id.inference.curvature import covariance
from capsule_id.inference.least_squares import SOLVER, LeastSquaresFit, Solver, least_squares

Model = Callable[[jax.Array, np.ndarray], jax.Array]


@dataclass(frozen=True)
class StrdProblem:
    """One data set: model(b, x) with b (d,), data (n, 2) as columns y, x, starts (2, d), certified values."""

    name: str
    level: Literal["lower", "average", "higher"]
    model: Model
    data: np.ndarray
    starts: np.ndarray
    values: np.ndarray
    standard_deviations: np.ndarray
    residual_sum_of_squares: float

    def residual(self, b: jax.Array) -> jax.Array:
        """(n,) measured − predicted, units of y."""
        return jnp.asarray(self.data[:, 0]) - self.model(b, self.data[:, 1])


def _problem(
    name: str, level: Literal["lower", "average", "higher"], model: Model, table: str, sum_of_squares: float, rows: str
) -> StrdProblem:
    """``table``: one line per parameter (start 1, start 2, value, sd); ``rows``: y x pairs separated by commas."""
    parameters = np.array([line.split() for line in table.strip().splitlines()], dtype=float)
    data = np.array([pair.split() for pair in rows.split(",")], dtype=float)
    return StrdProblem(
        name, level, model, data, parameters[:, :2].T, parameters[:, 2], parameters[:, 3], sum_of_squares
    )


_MISRA = """10.07 77.6, 14.73 114.9, 17.94 141.1, 23.93 190.8, 29.61 239.9, 35.18 289.0, 40.02 332.8, 44.82 378.4,
    50.76 434.8, 55.05 477.3, 61.01 536.8, 66.40 593.1, 75.47 689.1, 81.78 760.0"""

PROBLEMS: tuple[StrdProblem, ...] = (
    _problem(
        "Misra1a",
        "lower",
        lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
        """500    250    2.3894212918E+02 2.7070075241E+00
           0.0001 0.0005 5.5015643181E-04 7.2668688436E-06""",
        1.2455138894e-01,
        _MISRA,
    ),
    _problem(
        "DanWood",
        "lower",
        lambda b, x: b[0] * x ** b[1],
        """1 0.7 7.6886226176E-01 1.8281973860E-02
           5 4   3.8604055871E+00 5.1726610913E-02""",
        4.3173084083e-03,
        "2.138 1.309, 3.421 1.471, 3.597 1.490, 4.340 1.565, 4.882 1.611, 5.660 1.680",
    ),
    _problem(
        "Chwirut2",
        "lower",
        lambda b, x: jnp.exp(-b[0] * x) / (b[1] + b[2] * x),
        """0.1  0.15  1.6657666537E-01 3.8303286810E-02
           0.01 0.008 5.1653291286E-03 6.6621605126E-04
           0.02 0.010 1.2150007096E-02 1.5304234767E-03""",
        5.1304802941e02,
        """92.9 0.5, 57.1 1.0, 31.05 1.75, 11.5875 3.75, 8.025 5.75, 63.6 0.875, 21.4 2.25, 14.25 3.25, 8.475 5.25,
        63.8 0.75, 26.8 1.75, 16.4625 2.75, 7.125 4.75, 67.3 0.625, 41.0 1.25, 21.15 2.25, 8.175 4.25, 81.5 0.5,
        13.12 3.0, 59.9 0.75, 14.62 3.0, 32.9 1.5, 5.44 6.0, 12.56 3.0, 5.44 6.0, 32.0 1.5, 13.95 3.0, 75.8 0.5,
        20.0 2.0, 10.42 4.0, 59.5 0.75, 21.67 2.0, 8.55 5.0, 62.0 0.75, 20.2 2.25, 7.76 3.75, 3.75 5.75, 11.81 3.0,
        54.7 0.75, 23.7 2.5, 11.55 4.0, 61.3 0.75, 17.7 2.5, 8.74 4.0, 59.2 0.75, 16.3 2.5, 8.62 4.0, 81.0 0.5,
        4.87 6.0, 14.62 3.0, 81.7 0.5, 17.17 2.75, 81.3 0.5, 28.9 1.75""",
    ),
    _problem(
        "Misra1d",
        "average",
        lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
        """500    450    4.3736970754E+02 3.6489174345E+00
           0.0001 0.0003 3.0227324449E-04 2.9334354479E-06""",
        5.6419295283e-02,
        _MISRA,
    ),
    _problem(
        "MGH17",
        "average",
        lambda b, x: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
        """50   0.5   3.7541005211E-01 2.0723153551E-03
           150  1.5   1.9358469127E+00 2.2031669222E-01
           -100 -1   -1.4646871366E+00 2.2175707739E-01
           1    0.01  1.2867534640E-02 4.4861358114E-04
           2    0.02  2.2122699662E-02 8.9471996575E-04""",
        5.4648946975e-05,
        """0.844 0, 0.908 10, 0.932 20, 0.936 30, 0.925 40, 0.908 50, 0.881 60, 0.850 70, 0.818 80, 0.784 90, 0.751 100,
        0.718 110, 0.685 120, 0.658 130, 0.628 140, 0.603 150, 0.580 160, 0.558 170, 0.538 180, 0.522 190, 0.506 200,
        0.490 210, 0.478 220, 0.467 230, 0.457 240, 0.448 250, 0.438 260, 0.431 270, 0.424 280, 0.420 290, 0.414 300,
        0.411 310, 0.406 320""",
    ),
    _problem(
        "Roszman1",
        "average",
        lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
        """0.1      0.2       2.0196866396E-01 1.9172666023E-02
           -0.00001 -0.000005 -6.1953516256E-06 3.2058931691E-06
           1000     1200      1.2044556708E+03 7.4050983057E+01
           -100     -150      -1.8134269537E+02 4.9573513849E+01""",
        4.9484847331e-04,
        """0.252429 -4868.68, 0.252141 -4868.09, 0.251809 -4867.41, 0.297989 -3375.19, 0.296257 -3373.14,
        0.295319 -3372.03, 0.339603 -2473.74, 0.337731 -2472.35, 0.333820 -2469.45, 0.389510 -1894.65,
        0.386998 -1893.40, 0.438864 -1497.24, 0.434887 -1495.85, 0.427893 -1493.41, 0.471568 -1208.68,
        0.461699 -1206.18, 0.461144 -1206.04, 0.513532 -997.92, 0.506641 -996.61, 0.505062 -996.31,
        0.535648 -834.94, 0.533726 -834.66, 0.568064 -710.03, 0.612886 -530.16, 0.624169 -464.17""",
    ),
    _problem(
        "Thurber",
        "higher",
        lambda b, x: (b[0] + x * (b[1] + x * (b[2] + x * b[3]))) / (1 + x * (b[4] + x * (b[5] + x * b[6]))),
        """1000 1300 1.2881396800E+03 4.6647963344E+00
           1000 1500 1.4910792535E+03 3.9571156086E+01
           400  500  5.8323836877E+02 2.8698696102E+01
           40   75   7.5416644291E+01 5.5675370270E+00
           0.7  1    9.6629502864E-01 3.1333340687E-02
           0.3  0.4  3.9797285797E-01 1.4984928198E-02
           0.03 0.05 4.9727297349E-02 6.5842344623E-03""",
        5.6427082397e03,
        """80.574 -3.067, 84.248 -2.981, 87.264 -2.921, 87.195 -2.912, 89.076 -2.840, 89.608 -2.797, 89.868 -2.702,
        90.101 -2.699, 92.405 -2.633, 95.854 -2.481, 100.696 -2.363, 101.060 -2.322, 401.672 -1.501, 390.724 -1.460,
        567.534 -1.274, 635.316 -1.212, 733.054 -1.100, 759.087 -1.046, 894.206 -0.915, 990.785 -0.714,
        1090.109 -0.566, 1080.914 -0.545, 1122.643 -0.400, 1178.351 -0.309, 1260.531 -0.109, 1273.514 -0.103,
        1288.339 0.010, 1327.543 0.119, 1353.863 0.377, 1414.509 0.790, 1425.208 0.963, 1421.384 1.006, 1442.962 1.115,
        1464.350 1.572, 1468.705 1.841, 1447.894 2.047, 1457.628 2.200""",
    ),
    _problem(
        "Rat42",
        "higher",
        lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
        """100 75   7.2462237576E+01 1.7340283401E+00
           1   2.5  2.6180768402E+00 8.8295217536E-02
           0.1 0.07 6.7359200066E-02 3.4465663377E-03""",
        8.0565229338e00,
        "8.930 9, 10.800 14, 18.590 21, 22.330 28, 39.350 42, 56.110 57, 61.730 63, 64.620 70, 67.080 79",
    ),
    _problem(
        "Rat43",
        "higher",
        lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
        """100 700  6.9964151270E+02 1.6302297817E+01
           10  5    5.2771253025E+00 2.0828735829E+00
           1   0.75 7.5962938329E-01 1.9566123451E-01
           1   1.3  1.2792483859E+00 6.8761936385E-01""",
        8.7864049080e03,
        """16.08 1, 33.83 2, 65.80 3, 97.20 4, 191.55 5, 326.20 6, 386.87 7, 520.53 8, 590.03 9, 651.92 10, 724.93 11,
        699.56 12, 689.96 13, 637.56 14, 717.41 15""",
    ),
    _problem(
        "Eckerle4",
        "higher",
        lambda b, x: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
        """1   1.5 1.5543827178E+00 1.5408051163E-02
           10  5   4.0888321754E+00 4.6803020753E-02
           500 450 4.5154121844E+02 4.6800518816E-02""",
        1.4635887487e-03,
        """0.0001575 400, 0.0001699 405, 0.0002350 410, 0.0003102 415, 0.0004917 420, 0.0008710 425, 0.0017418 430,
        0.0046400 435, 0.0065895 436.5, 0.0097302 438, 0.0149002 439.5, 0.0237310 441, 0.0401683 442.5, 0.0712559 444,
        0.1264458 445.5, 0.2073413 447, 0.2902366 448.5, 0.3445623 450, 0.3698049 451.5, 0.3668534 453, 0.3106727 454.5,
        0.2078154 456, 0.1164354 457.5, 0.0616764 459, 0.0337200 460.5, 0.0194023 462, 0.0117831 463.5, 0.0074357 465,
        0.0022732 470, 0.0008800 475, 0.0004579 480, 0.0002345 485, 0.0001586 490, 0.0001143 495, 0.0000710 500""",
    ),
    _problem(
        "BoxBOD",
        "higher",
        lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
        """1 100  2.1380940889E+02 1.2354515176E+01
           1 0.75 5.4723748542E-01 1.0455993237E-01""",
        1.1680088766e03,
        "109 1, 149 2, 149 3, 191 5, 213 7, 224 10",
    ),
    _problem(
        "MGH09",
        "higher",
        lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
        """25   0.25  1.9280693458E-01 1.1435312227E-02
           39   0.39  1.9128232873E-01 1.9633220911E-01
           41.5 0.415 1.2305650693E-01 8.0842031232E-02
           39   0.39  1.3606233068E-01 9.0025542308E-02""",
        3.0750560385e-04,
        """0.1957 4, 0.1947 2, 0.1735 1, 0.1600 0.5, 0.0844 0.25, 0.0627 0.167, 0.0456 0.125, 0.0342 0.1, 0.0323 0.0833,
        0.0235 0.0714, 0.0246 0.0625""",
    ),
    _problem(
        "MGH10",
        "higher",
        lambda b, x: b[0] * jnp.exp(b[1] / (x + b[2])),
        """2      0.02 5.6096364710E-03 1.5687892471E-04
           400000 4000 6.1813463463E+03 2.3309021107E+01
           25000  250  3.4522363462E+02 7.8486103508E-01""",
        8.7945855171e01,
        """34780 50, 28610 55, 23650 60, 19630 65, 16370 70, 13720 75, 11540 80, 9744 85, 8261 90, 7030 95, 6005 100,
        5147 105, 4427 110, 3820 115, 3307 120, 2872 125""",
    ),
)


@jax.jit
def _both(residual: Partial, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    return residual(x), jax.jacfwd(residual)(x)


def solve(residual: Callable[[jax.Array], jax.Array], starts: np.ndarray, solver: Solver = SOLVER) -> LeastSquaresFit:
    """Least squares of a JAX function, its Jacobian in forward mode.

    The arrays of a ``Partial`` are arguments of the program: fits of other data compile nothing.
    """
    function = residual if isinstance(residual, Partial) else Partial(residual)

    def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residuals, jacobian = _both(function, jnp.asarray(x))
        return np.asarray(residuals), np.asarray(jacobian)

    return least_squares(linearise, starts, solver)


def best_of(fit: LeastSquaresFit) -> int:
    """Index of the start with the smallest cost among those that converged."""
    return int(np.argmin(np.where(fit.stalled, np.inf, fit.cost)))


def residual_sd_of(fit: LeastSquaresFit, start: int | None = None) -> float:
    """Estimate of the sd of the residuals at the end of ``start``, by default the best one."""
    index = best_of(fit) if start is None else start
    n, d = fit.jacobian[index].shape
    return float(np.sqrt(2.0 * fit.cost[index] / (n - d)))


def covariance_of(fit: LeastSquaresFit, residual_sd: float | None = None, start: int | None = None) -> np.ndarray:
    """Covariance (d, d) at the end of ``start``, by default the best one, with the sd of its own residuals by default."""
    index = best_of(fit) if start is None else start
    return (residual_sd or residual_sd_of(fit, index)) ** 2 * covariance(fit.jacobian[index])


def errors_of(fit: LeastSquaresFit, residual_sd: float | None = None, start: int | None = None) -> np.ndarray:
    """Standard errors (d,); parameters as in ``covariance_of``."""
    return np.sqrt(np.diag(covariance_of(fit, residual_sd, start)))
