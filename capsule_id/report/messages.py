"""The words of the report for checks and tables, by code; kinds of experiments declare those of their own."""

from collections.abc import Mapping
from typing import Literal

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.lint import TONE
from capsule_id.experiments.kind import Registry
from capsule_id.views import Facts, Finding, Level, Message, ResultTable, after_number, counted, filled_in, stated_p

# terms: The statistical terms of the report, each in one sentence.


#: Meaning of each word of trust.
TRUST: Mapping[str, str] = {
    "trusted": "No check found a fault that concerns this parameter: quote it.",
    "not judged": "A check warns that this number may be wrong, or could not be made: do not quote it before that is settled.",
    "not trusted": "A check that concerns this parameter failed: do not quote it.",
}
TERMS: Mapping[str, str] = {
    **TRUST,
    "bench tests, runs": "Bench tests: all experiments without a drive, such as decays, tilts and pushes. Runs are driven.",
    "x_rel": "Displacement of the rod relative to the capsule.",
    "P-1-F-2": "A motion that repeats after 1 period of the drive, moves forward (B: backward), and has 2 contacts in it.",
    "[rig], [model], [prior]": "Tables of the file rig.toml. Lines that the advice quotes belong there.",
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
    "chi-square": "Sum of the squared residuals; for a good fit about the number of readings less that of parameters.",
    "autocorrelation time": "Number of steps of the sampler after which a draw no longer depends on an earlier one.",
    "Pareto shape": "How much one reading changes the sample. Above the limit the sample cannot predict that reading.",
    "ESS": "Effective sample size: number of independent draws as informative as the sample; the smaller one of its middle and "
    "its tails.",
}
#: Terms that appear only where there is a sample.
OF_A_SAMPLE = frozenset({"95 % interval", "R-hat", "ESS", "autocorrelation time", "Pareto shape"})


# posterior: Texts of findings on the maximum, the sample and the priors of a fit, by code.


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
    size = abs(facts["fitted"])
    ends = f"mean = 0, sd = {2.0 * size:.2g}" if facts["signed"] else f"median = {size:.3g}, factor = 10"
    default = f'{ends}, unit = "{unit.strip() or 1}"'
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
    name, unit = facts["name"], after_number(facts["unit"])
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
    check = "Check the values and units of the readings and of rig.toml"
    if not facts["keys"]:
        return f"{seen} {check}."
    return f"{seen} {check}; if they are right, state in [prior] a wider or better placed prior of {facts['keys']}."


_SMOOTHED = (
    "the smoothed engine (velocity {velocity:g} m/s, penetration {penetration:g} m) integrates the capsule; the {other} model "
    "would shift no parameter by more than {largest:.2g} sd"
)
_BIASED = ". Expected {wanted:g} sd or less, but not of {names}: {remedy}."
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


# readings: Texts of findings on the readings of a rig, by code.


def _unusual(facts: Facts) -> str:
    """The number, the usual interval, the unit that was probably meant, and the line that confirms the number."""
    of, unit = (
        "times are" if "period" in facts["name"] else "number is",
        "" if facts["unit"] == "1" else f" {facts['unit']}",
    )
    meant = f" If the {of} in {facts['meant']}, write that unit." if facts["meant"] else ""
    scales = " and ".join(facts.get("scales", [facts["name"]]))
    line = f" If it is right, write this line in [rig] of rig.toml: {facts['line']}" if "line" in facts else ""
    return (
        f"{facts['name']} is {facts['value']:.4g}{unit}; {facts['low']:.3g} to {facts['high']:.3g}{unit} is usual. Check "
        f"the unit of {scales}.{meant} What it scales is not judged.{line}"
    )


def _repeated(facts: Facts) -> str:
    """The rows that stand twice."""
    line, last, first, end = (facts[key] for key in ("line", "last", "first_line", "first_last"))
    later, earlier = f"lines {line} to {last} repeat lines", f"{first} to {end}"
    if line == last:
        later, earlier = f"line {line} repeats line", f"{first}"
    if (facts["file"], line, last) == (facts["first"], first, end):
        return (
            f"{facts['file']}:{line}: each reading must stand once; two experiments use {later.partition(' repeat')[0]}. Let "
            "their where select different rows (both ends of a range count), or remove one experiment."
        )
    return (
        f"{facts['file']}:{line}: each reading must stand once; {later} {earlier} of {facts['first']}. "
        f"Delete the repeated {'row' if line == last else 'rows'}."
    )


def _spikes(facts: Facts) -> str:
    """The samples that stand off, and what drops them."""
    number, place = len(facts["rows"]), f"{facts['file']}:{facts['line']}: {facts['column']} must be smooth;"
    if number == 1:
        size = f"at {facts['time']:.5g} s stands off by {facts['size']:.2g} of the amplitude"
        return f"{place} one sample {size}. Delete its row."
    return (
        f"{place} {counted(number, 'single sample')} stand off (lines {facts['lines']}). Add this line to the experiment in "
        f"rig.toml, which drops them: reject = {facts['rule']}"
    )


_DROPPED = "{file}: the fit drops {rows:# row} with a missing reading and uses {used}."


def _missing(facts: Facts) -> str:
    """How many readings are missing, where that matters, and what to do."""
    where = f"That is {100.0 * facts['share']:.1f} %; at most 5 % may be missing"
    if facts["near"]:
        where = f"Of these, {facts['near']} in the two periods after the release, where none may be missing"
    remedy = "If readings are missing because of their size, the result is wrong. Find the cause, or measure again."
    return filled_in(f"{_DROPPED} {where}. What this file determines is not judged. {remedy}", facts)


DATA_MESSAGES: Mapping[str, Message] = {
    "masses.exact": Message(
        "masses", warn="{name}: no sd stated, so its value counts as exact. State the weighing error."
    ),
    "readings.few": Message(
        "number of readings",
        warn="too few rows to estimate the scatter: {rows} instead of {wanted}. Measure more rows.",
    ),
    "readings.encoding": Message(
        "encoding", ok="{file} is read as {encoding}, because it is no UTF-8. Check letters such as µ in its headers."
    ),
    "readings.missing": Message(
        "missing readings",
        ok=_DROPPED,
        warn=_missing,
    ),
    "readings.sheets": Message(
        "sheets",
        ok="{file}: read from sheet {sheet!r}. Not read: {others}, which hold numbers too. Name one by sheet, an entry each.",
    ),
    "times.stamps": Message(
        "time stamps", ok="{file}: {rows:# time stamp} are read as seconds since the first one, over midnight too."
    ),
    "times.records": Message(
        "several records",
        ok="{file}: the clock starts anew at lines {lines}. The {records} records are fitted as so many experiments.",
    ),
    "times.parts": Message(
        "several releases",
        ok="{file}: cut at its releases. The decays fitted, {records}: {used}. Left out: {left}.",
    ),
    "times.copies": Message(
        "repeated rows",
        warn="{file}:{line}: {rows:# row} repeat the row before, time and readings. The fit drops them. Check the export.",
    ),
    "times.held": Message(
        "repeated times",
        warn=(
            "{file}:{line}: {rows:# time stamp} repeat the one before, because the clock stood still and then made up for it. "
            "These rows get times between their neighbours. Check the logger."
        ),
    ),
    "times.ticks": Message(
        "rounded times",
        warn=(
            "{file}:{line}: the times are rounded to {tick:.4g} {unit}: {rows:# row} repeat the time before. No stamp "
            "contradicts even samples, so the fit takes a step of {step:.6g} {unit} from their number. "
            "Its relative sd, {sd:.1g}, is in the uncertainties. Export times with more digits."
        ),
    ),
    "readings.rejected": Message(
        "outliers",
        warn=(
            "{file}: the rule reject drops {rows:# row} as outliers, the fit uses {used}. Check with --figures that no impact "
            "or step is among them."
        ),
    ),
    "readings.errors": Message(
        "reading errors", warn="no reading error is stated for {names}. Add {first}_sd to the experiment."
    ),
    "readings.one_value": Message(
        "reading errors",
        warn=(
            "{name} has one value and an sd in all rows. The fit takes that for an error of its own in each row, whose mean is "
            "smaller, so mu is not judged. Where it was measured once, remove {name}_sd, write {name}_instrument = "
            '"of_{name}" in its place, and add at the end of rig.toml: [[instrument]], then name = "of_{name}", then offset = '
            '{{ value = 0, sd = {sd:.4g}, unit = "{unit}" }}. Where it was measured in each row, give its readings.'
        ),
    ),
    "readings.repeated_file": Message(
        "repeated readings",
        fail=(
            "{file} has the same content as the file of {first}, so each reading counts more than once. Remove one of "
            "the two experiments."
        ),
    ),
    "readings.repeated": Message(
        "repeated readings",
        fail=_repeated,
    ),
    "readings.magnitude": Message("magnitudes", warn=_unusual, on_console=True),
    "decays.magnitude": Message("magnitudes", warn=_unusual, on_console=True),
    "settings.sd": Message(
        "stated sd",
        warn="{name} is {value:.4g} ± {sd:.4g} in SI units: 0 is less than 2 sd away. State the sd of a measurement.",
    ),
    "readings.gaps": Message(
        "gaps in a record",
        warn=(
            "{file}:{line}: the times must be evenly spaced; found {lost:# missing sample} of {step:.4g} s, the first after "
            "{time:.6g} s. The fit uses the times as recorded. Record without gaps."
        ),
    ),
    "readings.rounded_times": Message(
        "rounded times",
        warn="{file}: the times are rounded to {step:g} s, which is 2 % of a sampling step or more. Export more digits.",
    ),
    "readings.clipped": Message(
        "clipped samples",
        fail=(
            "{file}:{line}: {column} is clipped at its {side} limit {level:.5g} {unit}: {samples:# sample} "
            "({share:.2g} of the record), the last at {time:.5g} s. Use the record after the clipped part only, or "
            "repeat with a wider range of the sensor. {cut}"
        ),
    ),
    "readings.dropouts": Message(
        "drop-outs",
        fail=(
            "{file}:{line}: {column} drops out: {samples:# sample} far from both neighbours, the first "
            "{value:.6g} {unit} at {time:.5g} s. Delete these rows: lines {lines}."
        ),
    ),
    "readings.frozen": Message(
        "frozen channel",
        fail=(
            "{file}:{line}: {column} freezes: {samples:# sample} with the value before, the first {value:.6g} {unit} at "
            "{time:.5g} s. Delete these rows: lines {lines}."
        ),
    ),
    "readings.jump": Message(
        "lost samples",
        fail=(
            "{file}:{line}: {column} must be smooth; it jumps at {time:.5g} s by {size:.2g} of its amplitude, and the times "
            "are even. Samples may be lost, or the rig was struck or moved. Use the record on one side of the jump only, "
            "or repeat it. {cut}"
        ),
    ),
    "readings.burst": Message(
        "bursts of noise",
        fail=(
            "{file}:{line}: {column} must have the same noise throughout; from {begin:.5g} to {end:.5g} s it has more than "
            "three times the usual noise. {cut}"
        ),
    ),
    "readings.spike": Message(
        "spikes",
        fail=_spikes,
    ),
}


# messages: The words of the report for the checks and tables of a fit, by code; kinds of experiments declare those of
# their own.


#: Errors of a text that does not match its facts.
TEXT_ERRORS = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError)


def messages_of(registry: Registry) -> Mapping[str, Message]:
    """The words of every code: those of the fit, of the readings, and those that the kinds of ``registry`` declare.

    Raises
    ------
    InputError
        If a kind declares a code of the fit as a whole.
    """
    for kind in registry.kinds:
        if own := sorted((FIT_MESSAGES.keys() | DATA_MESSAGES.keys()) & kind.messages.keys()):
            raise InputError(
                f"the kind {kind.name} must not declare messages of the whole fit",
                ", ".join(own),
                "rename these codes in the kind's messages",
            )
    return {**FIT_MESSAGES, **DATA_MESSAGES, **registry.messages}


def title_of(code: str, messages: Mapping[str, Message]) -> str:
    """The title of a check or a table; the code itself where no kind declares words for it."""
    return messages[code].title if code in messages else code


#: The question of a check; behind it the number that answers it and the limit, as far as its facts have them.
QUESTIONS: Mapping[str, str] = {
    "starts.agree": "Do all starting points end at the same maximum? {elsewhere} of {starts} ended elsewhere, limit 0.",
    "chains.converged": (
        "Has the sampler converged? R-hat {rhat:.4f}, limit {rhat_wanted:g}; {length:.0f} autocorrelation times, at least "
        "{length_wanted:.0f}; effective sample size {size:.0f}, at least {size_wanted:.0f}."
    ),
    "readings.decisive": "Does one reading decide a parameter? {far} of {number} do (Pareto shape above {limit:g}).",
    "sample.maximum": "Does the maximum lie within the sample? {distance:.1f} sd apart, limit 3.",
    "sample.modes": "Does the sample have one mode?",
    "parameters.informed": "Do the data narrow the prior of every parameter?",
    "priors.conflict": "Do priors and data agree? {z:+.1f} sd apart ({p:p}), limit p = 0.002 over all priors.",
    "priors.tails": "Does a parameter end in the tail of its prior? {furthest}: {pull:.2g} sd from its middle, limit 2.5.",
    "residuals.white": "Are the residuals of each record white? {p:p}, limit 0.002 over all records.",
    "trials.order": (
        "Are neighbouring trials independent? Correlation {correlation:.2f} ({p:p}), limits 0.2 and p = 0.005 over all tables."
    ),
    "trials.tables": "Do tables of equal tests agree? They scatter {factor:.1f} times too much ({p:p}), limit p = 0.005.",
    "trials.loads": "Is the friction in proportion to the normal force? {p:p}, limit 0.005.",
    "trials.speeds": "Does the friction fall with the speed as the law says? {p:p}, limit 0.005.",
    "residuals.statistics": "Do the residuals look like random noise? {p:p}, limit 0.002 over all statistics.",
    "outliers": "Does a reading stand apart? {score:.3g} sd off ({p:p}), limit p = 0.002 over all readings.",
    "errors.stated": "Do the stated errors explain the scatter? Chi-square {chi_square:.0f}, expected {freedom}.",
    "bench_and_runs.agree": (
        "Do bench tests and forced runs agree? {distances[0][0]}: {distances[0][1]:+.1f} sd apart, "
        "p = {distances[0][2]:.2g}, limit 0.02."
    ),
    "model.engine": "Would the exact engine change the numbers? By {largest:.2g} sd, limit {wanted:g}.",
    "runs.predictable": "Does one initial state predict the whole run? Its error grows {growth:.2g} times, limit 1000.",
    "runs.repeated": "Does the misfit repeat with the excitation? {p:p}, limit 0.002 over all channels.",
    "decays.halves": "Do both halves of the record agree? {name}: {z:.2g} sd apart, limit 4 (warning 3) of one record.",
    "decays.hidden": "Do the records exclude further forces?",
    "decays.held": "Is the instant of the release known?",
    "decays.onset": "Does the first half period change the numbers? {p:p}, limit 0.002 over all records.",
    "decays.stiffness": "Is k1 the same at all amplitudes? {p:p}, limit 0.002.",
    "decays.position": "Do the residuals depend on the position? {p:p}, limit 0.002 over all records.",
    "decays.residuals": "Do the residuals grow with the amplitude? {p:p}, limit 0.002 over all records.",
    "decays.drift": "Is the drift of the zero slower than the motion? Its part at that frequency is {share:.1%}.",
    "lines.straight": (
        "Is the calibration line straight? "
        "It bends by {departure:.1%} of the range ({p:p}), limit p = 0.002 over all lines."
    ),
    "lines.origin": "Does the line pass through the origin? It misses it by {intercept:.2g} {unit} ({p:p}), limit p = 0.002.",
    "lines.replicates": (
        "Do the means of repeated readings lie on the line? "
        "{deviation:.1f} sd of a reading off ({p:p}), limit p = 0.002."
    ),
    "lines.branches": "Are loading and unloading the same? {share:.1%} of the range apart ({p:p}), limit p = 0.002.",
    "friction.order": "Do the residuals of the friction tests show an order in speed? {p:p}, limit 0.002.",
    "friction.one_surface": "Do tilts and slides show one surface? {p:p}, limit 0.002.",
    "friction.variants": (
        "Would another friction law matter? The best one is {factor:.3g} times as probable, limit 100; "
        "over all laws a value is {shift:.2g} times as uncertain, limit 3."
    ),
    "springs.cantilever": "Does k2 fall as L^-3? The exponent is {exponent:.3f} ± {sd:.3f} ({p:p}), limit p = 0.002.",
}


def question_of(finding: Finding) -> str:
    """Question, number and limit of a check; the question alone where a fact is missing; "" for a code without one."""
    asked = QUESTIONS.get(finding.code, "")
    try:
        return filled_in(asked, finding.facts)
    except TEXT_ERRORS:
        return asked.partition("?")[0] + "?"


def finding_text(finding: Finding, messages: Mapping[str, Message]) -> str:
    """The text of a finding, with its experiment in front where the text does not name it itself.

    A finding whose code has no words, or faulty ones, is given by its facts.
    """
    if finding.code in messages:
        text = _filled_in(finding.code, finding.level, finding.facts, messages)
    else:
        text = _listed(finding.facts)
    if not finding.experiment or finding.experiment in text:
        return text
    return f"{finding.experiment}: {text}"


def caption_of(table: ResultTable, messages: Mapping[str, Message]) -> str:
    """The caption of a table; its facts where the caption is faulty, "" where no kind declares words for it."""
    return _filled_in(table.code, "caption", table.facts, messages) if table.code in messages else ""


def _filled_in(code: str, part: Level | Literal["caption"], facts: Facts, messages: Mapping[str, Message]) -> str:
    """The text of a code; where the text is faulty, the error and the facts. A faulty text must not end a fit."""
    try:
        return messages[code].text(part, facts)
    except TEXT_ERRORS as error:
        return (
            f"the words of {code} are faulty ({type(error).__name__}: {error}); the facts: {_listed(facts) or 'none'}"
        )


def _listed(facts: Facts) -> str:
    return ", ".join(f"{name} = {value}" for name, value in facts.items())


def _coloured_residuals(facts: Facts) -> str:
    """The statistic, and the remedy of the model that predicts the record."""
    seen = (
        f"{facts['record']}: expected residuals without correlation in time (white); found Ljung–Box "
        f"Q = {facts['Q']:.0f} over {facts['lags']} lags "
        f"({stated_p(facts['p'])}). The model lacks an effect or the noise is coloured, and the intervals are not to be "
        "trusted."
    )
    remedies = {"capsule": _capsule_remedy, "decay": _decay_remedy}
    remedy = remedies.get(facts.get("model", ""), lambda facts: "Look at the residuals.")
    return f"{seen} {remedy(facts)}"


def _capsule_remedy(facts: Facts) -> str:
    """What to compare: the friction law, of which the fit knows one alone, and the noise."""
    advice = "Look at the residuals and the phase portrait."
    if facts.get("spring"):
        advice += " Check the support spring and the gap."
    if laws := facts.get("other_laws", ()):
        advice += f" The fit has {facts['law']}; compare it with {' or '.join(laws)} in [model]."
    if facts.get("noise") == "white":
        advice += (
            ' Where the sensor filters, remove noise = "white" from the entry: a second fit then has coloured noise.'
        )
    return advice


def _decay_remedy(facts: Facts) -> str:
    """What the fitted model of a free decay contains, and what is left to do."""
    present = f"Present in the fitted model: {', '.join(facts['present'])}. " if facts["present"] else ""
    if facts.get("tone"):
        return present + filled_in(TONE, facts) + " Remove its source, and record again, or state it as hum."
    cut = "Cut the record to free decay with start and stop"
    if (start := facts.get("start")) is not None:
        cut = f'Leave out the larger half of the amplitudes: write start = {{ value = {start:.10g}, unit = "s" }} in its entry'
    if facts["second"]:
        return f"{present}No model that a second fit offers passes. {cut}, or record again with less disturbance."
    if not facts.get("stated"):
        return f"{present}{cut}, or record again with less disturbance."
    words = facts["stated"]
    listed = " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    them = "them" if len(words) > 1 else "it"
    return f"{present}{cut}, or remove {listed} from its entry: a second fit then chooses {them}."


def _outliers(facts: Facts) -> str:
    """The lines of the file, how far they stand off, and what they do to the estimates."""
    lines = [str(line) for line in facts["lines"]]
    several = len(lines) > 1
    where = f"lines {', '.join(lines[:-1])} and {lines[-1]} stand up to" if several else f"line {lines[0]} stands"
    more = f" At most {facts['most']} rows are named: look at the whole table." if len(lines) == facts["most"] else ""
    change = "; ".join(
        f"{name} = {value:.5g}{after_number(unit)} with {'them' if several else 'it'}, {without:.5g} without"
        for name, unit, value, without in facts["estimates"]
    )
    return (
        f"{facts['file']} {where} {facts['score']:.3g} standard deviations off the others ({stated_p(facts['p'])}).{more} "
        f"{change}. Nothing was dropped: check the reading, then correct it or remove it yourself."
    )


def _tables_disagree(facts: Facts) -> str:
    """The estimate of each table, and what to do."""
    unit = after_number(facts["unit"])
    estimates = ", ".join(f"{value:.4g}{unit} by {label}" for label, value in facts["estimates"])
    return (
        f"expected tables that agree; found {facts['name']} = {estimates} ({stated_p(facts['p'])}). It depends on "
        f"what differs between them, such as load, day or speed; an sd of independent trials is too small by a factor of about "
        f"{facts['factor']:.1f}. Find the cause, or fit each table in a folder of its own."
    )


#: How to fit F0 + mu N.
_CONSTANT_FORCE = (
    " Where a constant force F0 acts besides (a load cell that reads F0 without load, surfaces that stick), F0 + mu N is "
    'fitted by force_instrument = "cell" in the entry, and [[instrument]], name = "cell", offset = {{ value = 0, sd = '
    '{:g}, unit = "N" }} on lines of their own; mu is then the slope.'
)


def _loads_differ(facts: Facts) -> str:
    """The coefficient at the loads, the lowest and the highest where there are many."""
    means = facts["means"]
    shown = means if len(means) <= 6 else [means[0], means[len(means) // 2], means[-1]]
    values = ", ".join(f"{coefficient:.3g} at {load:.3g} N" for load, coefficient in shown)
    return (
        f"expected friction in proportion to the normal force; found a coefficient of {values} ({stated_p(facts['p'])}). One "
        "coefficient does not hold for all loads. Fit the rows of similar loads in a folder of their own, and use the load "
        "that is nearest to the weight of the capsule. Where the speed changes with the load, look first at the friction law."
        + ("" if facts["instrument"] else _CONSTANT_FORCE.format(float(f"{max(x * y for x, y in means):.0g}")))
    )


def _unseen(facts: Facts) -> str:
    """The smallest error that a check of a setting sees in 8 of 10 cases, by parameter."""
    errors = ", ".join(f"{name} by {sd:.3g} sd" for name, sd in facts["unseen"].items() if sd < float("inf"))
    return (
        f"one that shifts {errors} is seen in 8 of 10 cases, a smaller one can stay unseen"
        if errors
        else "too few rows"
    )


#: What a statistic of the residuals that is too large means.
_STATISTICS: Mapping[str, str] = {
    "sign runs": "too many neighbours have the same sign",
    "largest": "one of them is too large",
    "trend": "they change slowly from the first reading to the last",
}


def _unlike_noise(facts: Facts) -> str:
    return (
        f"expected residuals like random noise; {_STATISTICS[facts['statistic']]} ({stated_p(facts['p'])}). A larger scatter "
        "does not explain this. Look at the residuals: a bend, a wrong model or a wrong reading."
    )


def _largest_disagreement(facts: Facts) -> str:
    (name, sd, p), *_ = facts["distances"]
    judge = " by the bench's sample" if facts["sampled"] else ""
    return (
        f"largest disagreement in {name} ({sd:+.1f} sd of the curvature, {stated_p(p)}{judge} over "
        f"{counted(facts['shared'], 'shared parameter')})"
    )


def _inconsistent(facts: Facts) -> str:
    (name, *_), *others = facts["distances"]
    further = "".join(f", then {other} ({sd:+.1f} sd, {stated_p(p)})" for other, sd, p in others)
    return (
        f"bench tests and forced runs are inconsistent: {_largest_disagreement(facts)}{further}. The bench's {name} does "
        f"not fit the recorded motion. Check units, clock and calibration of {facts['tests'] or 'its bench test'} and repeat "
        "it, or find what differs in the runs."
    )


FIT_MESSAGES: Mapping[str, Message] = {
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
        warn="the data reduce the prior sd of {names} by less than 10 %: the interval is mostly that of the prior. Add a test.",
    ),
    "priors.conflict": Message(
        "priors and data", ok="priors and weighings, {number} in all, agree with the rest of the data", fail=_conflict
    ),
    "priors.idle": Message(
        "priors",
        warn=(
            "[prior] {keys} has no effect: the fit has no such parameter. Remove the line, or add what measures it: a test, "
            "or the word of [model] free or of damping that adds this parameter."
        ),
    ),
    "priors.tails": Message(
        "boundary effects",
        ok="no parameter ends in the tail of its prior",
        warn=_tails,
    ),
    "residuals.white": Message(
        "residuals white",
        ok="residuals of {records:# record} are white (Ljung–Box, {lags} lags)",
        fail=_coloured_residuals,
    ),
    "trials.order": Message(
        "order of trials",
        ok="residuals of neighbouring rows are uncorrelated in {number:# table}",
        fail=(
            "expected independent residuals; those of neighbouring rows have correlation {correlation:.2f} over {rows} rows "
            "({p:p}). The trials drift or come in sessions, or loading and unloading differ: an sd of independent trials is "
            "too small by a factor of about {factor:.1f}. Repeat the trials in random order, with the test set up anew "
            "between them."
        ),
    ),
    "trials.tables": Message(
        "agreement of tables",
        ok="{number:# table} of equal tests agree within their scatter",
        fail=_tables_disagree,
    ),
    "trials.loads": Message(
        "friction against load",
        ok=lambda facts: f"no constant force beside the friction is seen; {_unseen(facts)}",
        warn=lambda facts: (
            f"{counted(facts['rows'], 'row')} cannot show whether friction is in proportion to the normal force: a constant "
            f"force beside it may be there ({_unseen(facts)}). Repeat the trials, at loads further apart, or fit the rows "
            "of one load in a folder of their own."
        ),
        fail=_loads_differ,
    ),
    "trials.speeds": Message(
        "fall of the friction",
        ok=lambda facts: f"no other fall of the friction with the speed is seen; {_unseen(facts)}",
        warn=lambda facts: (
            f"expected friction that falls with the speed as the law says; another fall, as with a constant force, has "
            f"{stated_p(facts['p'])} in {counted(facts['rows'], 'row')} ({_unseen(facts)}). Repeat the trials, at speeds "
            "further apart, or compare the friction laws in the report."
        ),
    ),
    "residuals.statistics": Message(
        "residuals like noise",
        ok="signs, largest residual and trend of {number:# bench test} are those of random noise",
        warn=_unlike_noise,
        fail=_unlike_noise,
    ),
    "model.engine": Message(
        "engine of the capsule model",
        ok=_SMOOTHED,
        warn=_SMOOTHED + _BIASED,
        fail=_SMOOTHED + _BIASED,
    ),
    "model.error": Message(
        "model error",
        warn=lambda facts: (
            "estimates from parts of the data scatter more than their sds say, so the quoted sd is multiplied by "
            + ", ".join(f"{factor:.3g} for {name} ({parts} parts)" for name, factor, parts in facts["factors"])
            + ". It is an estimate of the model's error; find its cause before you use the number."
        ),
        fail=lambda facts: (
            "parts of the data contradict each other, so there is no number for "
            + ", ".join(f"{name} (its sd would be multiplied by {factor:.3g})" for name, factor, _ in facts["factors"])
            + ". The model does not describe these readings: find the cause that the other failed checks name."
        ),
    ),
    "outliers": Message("outliers", ok="no reading stands apart from the others of its table", fail=_outliers),
    "errors.stated": Message(
        "stated errors",
        ok="stated reading errors explain the scatter",
        fail=(
            "expected a chi-square of about {freedom} from the stated reading errors; found {chi_square:.0f} "
            "({p:p}). The errors are larger than stated, or the line is not straight."
        ),
    ),
    "bench_and_runs.agree": Message(
        "bench and runs agree", ok=_largest_disagreement, warn=_inconsistent, fail=_inconsistent
    ),
    "bench_and_runs.estimates": Message(
        "bench and runs agree",
        warn=lambda facts: (
            f"expected finite estimates of {counted(facts['shared'], 'shared parameter')} from bench and runs; "
            f"there is none of {', '.join(facts['missing'])}, so nothing was compared. "
            "Look at what the records and tests determine."
        ),
    ),
    "runs.precision": Message(
        "Precision gained from forced runs",
        caption=(
            "Posterior standard deviation, SI. Runs only: from the curvature of their likelihood and the priors at the joint "
            "point fit. Bench and both: from the samples, where they were drawn."
        ),
    ),
    "runs.smoothing": Message(
        "Effect of smoothing",
        caption=(
            "The posterior is that of the {engine} model. A fit of the {other} model would shift the estimates by this much "
            "(u: logarithm). Widths of the smoothed model: velocity {velocity:g} m/s, penetration {penetration:g} m."
        ),
    ),
    "parameters.shares": Message(
        "Where the sd comes from",
        caption=(
            "Share of the two largest inputs in the variance of each parameter, from the curvature at the maximum: a table, a "
            "stated value with its sd (a weighing), or a prior."
        ),
    ),
    "parameters.identified": Message(
        "What the readings know",
        caption=(
            "bounded: the profile likelihood falls on both sides. upper limit, lower limit: on one side alone. flat: on none, "
            "so that the prior decides. tied to: the readings know a combination with that parameter better than either. "
            "Correlation: the largest one with another parameter, from the curvature at the maximum. sd / prior sd: near 1 "
            "where the readings say nothing."
        ),
    ),
    "parameters.profile": Message(
        "Profile likelihood of a parameter",
        caption=(
            "{name}, {unit}: log-likelihood maximised over all other parameters, which keep their priors, at fixed values; "
            "and the parabola of the curvature. 95 % interval, where it falls by {drop:.2f}: {lower} to {upper} (open: beyond "
            "the values). Beside it: the other physical parameters at the maximum."
        ),
    ),
    "parameters.priors": Message(
        "Priors",
        caption=(
            "Every prior is proper; a factor f holds 95 % within median/f to median×f. Amplitudes, offsets and intercepts "
            "have normal priors ten times as wide as their record and are integrated out in closed form."
        ),
    ),
    "readings.predictive": Message(
        "Posterior predictive checks",
        caption=(
            "Probability that a replicate misses the model by more than the readings do (chi-square discrepancy). Near 0: "
            "the readings scatter more than the fit allows. Where the scatter itself is estimated, it is near 0.5 by "
            "construction."
        ),
    ),
}
