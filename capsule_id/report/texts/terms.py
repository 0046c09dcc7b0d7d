"""The statistical terms of the report, each in one sentence."""

from collections.abc import Mapping

TERMS: Mapping[str, str] = {
    "posterior": "Distribution of the parameters that follows from the readings and the priors.",
    "sd": "Standard deviation. About 68 % of a normal distribution lies within ± 1 sd, and 95 % within ± 2 sd.",
    "95 % interval": "Range that holds the parameter with probability 0.95, with 0.025 on either side.",
    "prior": "What is assumed of a parameter before the readings: a weighing with its sd, or a wide default.",
    "scatter": "Standard deviation between repeated readings. It is estimated where rig.toml states no reading error.",
    "residual": "Measured value minus value of the model, in units of its sd.",
    "white": "Residuals are white where neighbours in time are not correlated. Coloured noise is not white.",
    "AR(1), ARMA": "Models of coloured noise. AR(1): the correlation of two samples falls exponentially with their distance.",
    "p": "Probability of a deviation at least as large by chance alone. If p is small, chance is an unlikely cause.",
    "point fit, MAP": "Parameters at the maximum of the posterior.",
    "log-posterior": "Logarithm of the posterior density. A difference of 3 means that a point is 20 times less probable.",
    "R-hat": "Compares independent runs of the sampler. 1 is perfect; above 1.01 they do not agree yet.",
    "ESS": "Effective sample size: number of independent draws that are as informative as the sample.",
}
#: Terms that appear only where there is a sample.
OF_A_SAMPLE = frozenset({"95 % interval", "R-hat", "ESS"})
