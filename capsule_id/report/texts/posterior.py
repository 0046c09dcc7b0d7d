"""Texts of findings on the maximum, the sample and the priors of a fit, by code."""

from collections.abc import Mapping

from capsule_id.views import Facts, Message, filled_in, stated_p

#: A larger difference in log-posterior is not printed: it may be that of a place which the model excludes.
FAR_BELOW = 1000


_DECISIVE = (
    "{far} of {number:# reading} or stretches decide a parameter almost alone, so that the sample cannot tell how well the "
    "others predict them (Pareto shape above {limit:g}; a stretch is named by its first reading): {rows}"
)
_NOT_DECISIVE = "each of {number:# reading} or stretches can be left out: the sample predicts it from the others"


def _disagreeing_starts(facts: Facts) -> str:
    seen = (
        f"expected {facts['starts']} starts to end at the same maximum; {facts['stalled']} stalled, {facts['elsewhere']} "
        "ended elsewhere"
    )
    if "name" not in facts:
        return f"{seen}. Look at the residuals, and at parameters that the data hardly determine."
    return f"{seen}, the furthest {facts['distance']:.2g} posterior sd away in {facts['name']}"


def _maxima_without_mass(facts: Facts) -> str:
    below, places = facts["below"], "lie within the sample"
    if below >= 1.0:
        lower = f"{below:.0f}" if below < FAR_BELOW else f"more than {FAR_BELOW}"
        places = f"are lower by {lower} in log-posterior or {places}"
    return f"{_disagreeing_starts(facts)}. Those ends {places}, so they change no number."


def _maxima_with_mass(facts: Facts) -> str:
    if "name" not in facts:
        return _disagreeing_starts(facts)
    return (
        f"{_disagreeing_starts(facts)}. Look for a second explanation of the records, or narrow the prior of that parameter "
        "in rig.toml."
    )


def _conflict(facts: Facts) -> str:
    """The prior, what the rest of the data give, and which entry to look at."""
    name, unit, experiments = facts["name"], facts["unit"], facts["experiments"]
    key, scale = facts["key"], f'scale = {facts["fitted"]:.2g}, unit = "{unit.strip() or 1}"'
    default = f'median = {facts["fitted"]:.3g}, factor = 10, unit = "{unit.strip() or 1}"'
    source, remedy = {
        "rig": (
            f"{name} of rig.toml" if "[" in name else f"[rig] {name}",
            f"Check value, sd and unit of {name} in rig.toml, and the units in {experiments}.",
        ),
        "prior": (
            f"[prior] {name}",
            f"Check value and unit of [prior] {name} in rig.toml and the units in {experiments}"
            + ("; remove a guessed prior." if key else "."),
        ),
        "": (
            f"the default prior of {name}",
            f"Check the units in {experiments}"
            + (f"; if they are right, write in [prior] {key} = {{ {default} }}." if key else "."),
        ),
        "scatter": (
            f"the default prior of {name}",
            f"The model does not follow {experiments}, or the readings scatter this much: look at the curve and the residuals"
            + (f". If the model is right, write in [prior] {key} = {{ {scale} }}." if key else "."),
        ),
    }[facts["stated"]]
    if facts["informed"] > 0.5:
        found = f"{experiments} and the other priors give {facts['value']:.5g} ± {facts['sd']:.2g}{unit}"
    else:
        found = f"{experiments} and the other priors pull it to {facts['fitted']:.5g}{unit}"
    remedy = f"They differ about 1000 times, as units do. {remedy}" if facts.get("is_unit") else remedy
    return (
        f"{source} ({facts['prior']}, SI) contradicts the rest of the data: {found}, {abs(facts['z']):.1f} sd away "
        f"({stated_p(facts['p'])}). {remedy}"
    )


def _modes(facts: Facts) -> str:
    """The modes of a parameter with their weights, or how far its maximum lies from the sample."""
    name, unit = facts["name"], "" if facts["unit"] == "1" else f" {facts['unit']}"
    prior = f", or state what you know of the rig as a prior of {facts['key']} in [prior]" if facts["key"] else ""
    if "modes" in facts:
        seen = " and ".join(f"{value:.4g}{unit} with weight {weight:.2f}" for value, weight in facts["modes"])
        return (
            f"expected one mode of the posterior of {name}; found {seen}. Median and sd describe none of them. Add a test "
            f"that tells them apart{prior}."
        )
    return (
        f"expected the maximum of the posterior within 3 sd of its sample; {name} = {facts['maximum']:.4g}{unit} at the "
        f"maximum, {facts['median']:.4g} ± {facts['sd']:.2g}{unit} in the sample ({facts['distance']:.1f} sd apart). The "
        f"residuals and curves are those of the maximum, so no check covers the quoted number. Add readings that determine "
        f"{name}{prior}."
    )


def _tails(facts: Facts) -> str:
    """The parameters whose priors pull, and those of them whose prior can be stated."""
    seen = f"{facts['names']} ended in the tail of the prior, which pulls the estimate."
    if not facts["keys"]:
        return f"{seen} Check the values and units of the readings and of rig.toml."
    return f"{seen} In [prior] state a wider or better placed prior of {facts['keys']}."


_CHAINS = (
    "{draws} draws of each ensemble are {length:.0f} autocorrelation times of {slowest}, smallest effective sample size "
    "{size:.0f} ({smallest}), largest split R-hat {rhat:.4f} ({worst})"
)


def _chains(facts: Facts) -> str:
    """The parameters whose sample is too short, or that there is no sample."""
    if not facts:
        return "no sample was drawn: there are no intervals"
    return filled_in(
        "the steps were used up before the sample of {names} was long enough, so these numbers are not judged. Expected more "
        "than {length_wanted:.0f} autocorrelation times, bulk and tail effective sample sizes of {size_wanted:.0f}, and R-hat "
        f"<= {{rhat_wanted}}; found {_CHAINS}. Raise --max-steps, or look for a parameter that the data do not inform.",
        facts,
    )


POSTERIOR_MESSAGES: Mapping[str, Message] = {
    "starts.agree": Message(
        "starts agree",
        ok="all {starts} starts of the point fit ended at the same maximum",
        warn=_maxima_without_mass,
        fail=_maxima_with_mass,
    ),
    "chains.converged": Message(
        "chains converged",
        ok=_CHAINS,
        warn=_chains,
    ),
    "readings.decisive": Message(
        "readings left out",
        ok=lambda facts: filled_in(_DECISIVE if facts["far"] else _NOT_DECISIVE, facts),
    ),
    "sample.unfinished": Message(
        "sample", warn="the sample is still to be drawn: this is the point fit alone, without intervals and figures"
    ),
    "sample.maximum": Message(
        "maximum and sample", ok="the sample of every physical parameter has one mode, at the maximum", fail=_modes
    ),
    "sample.modes": Message("maximum and sample", fail=_modes),
    "parameters.informed": Message(
        "parameters informed",
        ok="the data narrow the prior of every physical parameter",
        warn="the data hardly narrow the prior of {names}: the printed interval is that of the prior. Add a test.",
    ),
    "priors.conflict": Message(
        "priors and data", ok="priors and weighings, {number} in all, agree with the rest of the data", fail=_conflict
    ),
    "priors.tails": Message(
        "boundary effects",
        ok="no parameter ends in the tail of its prior",
        warn=_tails,
    ),
}
