"""Errors that all readings of one instrument share: stated once, a parameter of the fit, and in every sd."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.statistics import basis_of
from capsule_id.inference.checks.settings import design, outliers
from tests.rig.folder import write_folder

HEAD = '[rig]\nname = "a"\nm1 = { value = 0.11, unit = "kg" }\nm2 = { value = 0.53, unit = "kg" }\n'


def table(rng: np.random.Generator, columns: dict[str, np.ndarray], errors: dict[str, float]) -> str:
    """A CSV table with normal reading errors."""
    noisy = [values + errors[name] * rng.standard_normal(len(values)) for name, values in columns.items()]
    return (
        ",".join(columns) + "\n" + "".join(",".join(f"{x:.9g}" for x in row) + "\n" for row in zip(*noisy, strict=True))
    )


def bench(
    folder: Path, seed: int, gain: float = 0.0, offset: float = 0.0, stated: str = "", named: bool = True
) -> tuple[Path, dict[str, float]]:
    """A motor and a spring read by one load cell of a relative error ``gain``, and tilts read ``offset`` rad too large."""
    rng, true = np.random.default_rng(seed), {"K": 2.0, "k2[soft]": 2400.0, "mu": 0.5}
    current, deflection = np.linspace(0.25, 2.0, 8), np.linspace(0.0, 1.0, 9)
    angle = np.rad2deg(np.arctan(true["mu"]) + offset) * np.ones(12)
    files = {
        "motor.csv": table(
            rng,
            {"force [N]": (1.0 + gain) * true["K"] * current, "current [A]": current},
            {"force [N]": 2e-3, "current [A]": 0.0},
        ),
        "spring.csv": table(
            rng,
            {"deflection [mm]": deflection, "force [N]": (1.0 + gain) * true["k2[soft]"] * 1e-3 * deflection},
            {"deflection [mm]": 0.0, "force [N]": 2e-3},
        ),
        "tilt.csv": table(rng, {"angle [deg]": angle}, {"angle [deg]": 0.1}),
    }
    cell, level = ('force_instrument = "cell"\n', 'angle_instrument = "level"\n') if named else ("", "")
    text = (
        HEAD
        + stated
        + "".join(
            f'[[experiment]]\nkind = "{kind}"\nfile = "{file}"\n{more}'
            for kind, file, more in (
                ("motor_current", "motor.csv", cell),
                ("support_spring", "spring.csv", f'spring = "soft"\n{cell}'),
                ("static_friction", "tilt.csv", level),
            )
        )
    )
    return write_folder(folder, text, files), true


STATED = """
[[instrument]]
name = "cell"
gain = { expanded = 4, k = 2, unit = "%" }
[[instrument]]
name = "level"
offset = { half_width = 1.0, unit = "deg" }
"""
GAIN_SD, OFFSET_SD = 0.02, np.deg2rad(1.0) / np.sqrt(3.0)


def test_the_sd_holds_the_random_and_the_stated_part(tmp_path: Path) -> None:
    """Against the closed form: relative variances add; the motor and the spring share the gain of their load cell."""
    alone, true = bench(tmp_path / "alone", 1, named=False)
    stated, _ = bench(tmp_path / "stated", 1, stated=STATED)
    random, both = (cid.fit(cid.read_rig(folder), 0, budget=steps) for folder, steps in ((alone, None), (stated, 300)))
    slope = 1.0 + true["mu"] ** 2
    systematic = {"K": GAIN_SD * true["K"], "k2[soft]": GAIN_SD * true["k2[soft]"], "mu": OFFSET_SD * slope}
    for name, sd in systematic.items():
        expected = np.hypot(random.summary.loc[name, "sd"], sd)
        assert both.summary.loc[name, "sd"] == pytest.approx(expected, rel=0.1)
        assert both.summary.loc[name, "trust"] == "trusted"
    assert both.nuisances.loc["gain[cell]", "sd"] == pytest.approx(GAIN_SD, rel=0.1)
    assert both.nuisances.loc["offset[level]", "unit"] == "rad"
    draws = {name: both.posterior.draws[..., i].ravel() for i, name in enumerate(both.posterior.names)}
    assert np.corrcoef(draws["K"], draws["k2[soft]"])[0, 1] > 0.9


def test_a_stated_value_is_taken_off_the_readings(tmp_path: Path) -> None:
    """Negative control: without the statement K is 8 % off."""
    known = '[[instrument]]\nname = "cell"\ngain = { value = 8, unit = "%" }\n'
    known += '[[instrument]]\nname = "level"\noffset = { value = 2, unit = "deg" }\n'
    folder, true = bench(tmp_path / "a", 2, gain=0.08, offset=np.deg2rad(2.0), stated=known)
    wrong, _ = bench(tmp_path / "b", 2, gain=0.08, offset=np.deg2rad(2.0), named=False)
    corrected, plain = (cid.fit(cid.read_rig(one), budget=None).summary["value"] for one in (folder, wrong))
    for name, value in true.items():
        assert corrected[name] == pytest.approx(value, rel=0.01)
    assert plain["K"] == pytest.approx(1.08 * true["K"], rel=0.01)


def scores(folder: Path, seeds: range, *, named: bool) -> np.ndarray:
    """(estimate - truth)/sd of K, k2 and mu of rigs whose gain and zero are drawn from their statements."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng(seed + 10_000)
        gain, offset = GAIN_SD * rng.standard_normal(), OFFSET_SD * rng.standard_normal()
        rig, true = bench(folder / str(seed), seed, gain, offset, STATED if named else "", named)
        summary = cid.fit(cid.read_rig(rig), budget=None).summary
        found += [(summary.loc[name, "value"] - value) / summary.loc[name, "sd"] for name, value in true.items()]
    return np.array(found)


def test_intervals_cover_where_errors_are_stated(tmp_path: Path) -> None:
    """Fixed seeds: none of 24 beyond 3 sd. Negative control: without the statements most are."""
    assert np.mean(np.abs(scores(tmp_path / "stated", range(8), named=True)) > 3.0) == 0.0
    assert np.mean(np.abs(scores(tmp_path / "silent", range(4), named=False)) > 3.0) > 0.5


@pytest.mark.slow
def test_coverage_over_eighty_benches(tmp_path: Path) -> None:
    """K and k2 share the gain: 80 benches count as 160 independent intervals, with a binomial sd of 1.7 %."""
    z = scores(tmp_path, range(80), named=True)
    assert np.mean(np.abs(z) < 1.96) >= 0.95 - 3.0 * 0.017
    assert 0.85 <= np.std(z) <= 1.15
    assert np.mean(np.abs(z) > 3.0) <= 0.02


def motor(folder: Path, rows: int, errors: str, gain: str) -> cid.Fit:
    """A motor at ``rows`` currents, with errors of force and current, read by a load cell."""
    rng, current = np.random.default_rng(5), np.linspace(0.25, 2.0, rows)
    columns = {"force [N]": 2.0 * current, "current [A]": current}
    text = HEAD + f'[[instrument]]\nname = "cell"\ngain = {gain}\n'
    text += f'[[experiment]]\nkind = "motor_current"\nfile = "m.csv"\nforce_instrument = "cell"\n{errors}'
    content = table(rng, columns, {"force [N]": 0.03, "current [A]": 0.01})
    return cid.fit(cid.read_rig(write_folder(folder, text, {"m.csv": content})), budget=None)


BOTH = 'force_sd = { value = 0.03, unit = "N" }\ncurrent_sd = { value = 0.01, unit = "A" }\n'


@pytest.mark.parametrize(
    "errors", [BOTH, pytest.param('sd_ratio = { value = 3, unit = "N/A" }\n', marks=pytest.mark.full)]
)
def test_errors_of_both_columns_do_not_move_the_gain(tmp_path: Path, errors: str) -> None:
    """Only the product of K and the gain is seen. Before: a gain of -1.4 sd at 200 rows, and K by as much too large."""
    fitted, exact = (motor(tmp_path / sd, 200, errors, f'{{ value = 0, sd = {sd}, unit = "%" }}') for sd in ("2", "0"))
    assert abs(fitted.nuisances.loc["gain[cell]", "value"]) < 0.05 * 0.02
    assert fitted.summary.loc["K", "value"] == pytest.approx(exact.summary.loc["K", "value"], rel=1e-3)


def test_an_instrument_hides_no_digit_and_no_outlier(tmp_path: Path) -> None:
    """The stated gain is taken off, and the last digit of the readings is still known; so are outliers at a gain of 0."""
    values = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 9.0, 3.5, 4.0, 4.5, 5.0])
    lines = "".join(f"{force},{force / 2.0 + 0.001 * (-1) ** i}\n" for i, force in enumerate(values.tolist()))
    lines = lines.replace("9.0,4.499", "9.0,1.499")
    for name, gain in (("none", '{ value = 0.5, unit = "%" }'), ("some", '{ value = 0.5, sd = 2, unit = "%" }')):
        text = HEAD + f'[[instrument]]\nname = "cell"\ngain = {gain}\n'
        text += '[[experiment]]\nkind = "motor_current"\nfile = "m.csv"\nforce_instrument = "cell"\n'
        rig = cid.read_rig(write_folder(tmp_path / name, text, {"m.csv": "force [N],current [A]\n" + lines}))
        (e,) = make_experiments(rig)
        assert rig.tables[0].columns["force"].unstated_step == pytest.approx(0.1 / 1.005)
        theta = e.local({"K": 2.0, "scatter[m]": 0.01, "gain[cell]": 1e-9, "m1": 0.11, "m2": 0.53, "g": 9.81})
        assert [found.row for found in outliers(e, theta, 0.01)] == [5]
        # The gain moves the readings as K does, however near 0 it is: slope and intercept are all that the rows show.
        assert {basis_of(design(e, {**theta, "gain[cell]": x})[1]).shape[1] for x in (1e-15, 1e-12, 1e-9, 1e-6)} == {2}


def named_gains(folder: Path, seed: int, gain: float) -> set[str]:
    """What the fit says is wrong where two cells, of 1 % and 0.2 %, read one spring, the first by ``gain`` too much."""
    rng, deflection = np.random.default_rng(seed), np.linspace(0.0, 1.0, 11)
    text = HEAD + "".join(
        f'[[instrument]]\nname = "{name}"\ngain = {{ sd = {sd}, unit = "%" }}\n[[experiment]]\nkind = "support_spring"\n'
        f'spring = "soft"\nfile = "of_{name}.csv"\nforce_instrument = "{name}"\n'
        for name, sd in (("A", 1.0), ("B", 0.2))
    )
    files = {
        f"of_{name}.csv": table(
            rng,
            {"deflection [mm]": deflection, "force [N]": (1.0 + error) * 2.4 * deflection},
            {"deflection [mm]": 0.0, "force [N]": 2e-3},
        )
        for name, error in (("A", gain), ("B", 0.0))
    }
    fit = cid.fit(cid.read_rig(write_folder(folder, text, files)), budget=None)
    return {
        str(found.facts["name"]) for found in fit.findings if found.code == "priors.conflict" and found.level == "fail"
    }


def test_a_certificate_that_the_readings_contradict_is_named(tmp_path: Path) -> None:
    """Five stated sds off; half of one is no contradiction."""
    assert "gain[A]" in named_gains(tmp_path / "wrong", 0, 0.05)
    assert named_gains(tmp_path / "right", 0, 0.005) == set()


@pytest.mark.slow
def test_contradicted_certificates_are_named(tmp_path: Path) -> None:
    """Of 40 that are five sds off at least 80 % are named, of 40 that are right at most one."""
    wrong = ["gain[A]" in named_gains(tmp_path / f"w{seed}", seed, 0.05) for seed in range(40)]
    errors = 0.01 * np.random.default_rng(1).standard_normal(40)
    right = [bool(named_gains(tmp_path / f"r{seed}", seed, error)) for seed, error in enumerate(errors)]
    print(f"named: {sum(wrong)} of 40; false alarms: {sum(right)} of 40")
    assert np.mean(wrong) >= 0.8
    assert sum(right) <= 1


def test_heights_and_lengths_have_instruments(tmp_path: Path) -> None:
    """A ruler that reads 3 % too much on the height alone: mu of the base falls by it; of the board, by the sine."""
    for side, true in (("base", 0.5), ("board", 0.4)):
        ratio = true if side == "base" else np.sin(np.arctan(true))
        rows = "".join(f"{1030.0 * ratio + 0.2 * (-1) ** i:.4f},1000\n" for i in range(8))
        text = HEAD + '[[instrument]]\nname = "ruler"\ngain = { value = 3, sd = 1, unit = "%" }\n'
        text += f'[[experiment]]\nkind = "static_friction"\nfile = "t.csv"\nlength_is = "{side}"\nheight_instrument = "ruler"\n'
        folder = write_folder(tmp_path / side, text, {"t.csv": "height [mm],length [mm]\n" + rows})
        summary = cid.fit(cid.read_rig(folder), budget=None).summary
        assert summary.loc["mu", "value"] == pytest.approx(true, rel=2e-3)
        per_gain = true if side == "base" else true * (1.0 + true**2)
        assert summary.loc["mu", "sd"] == pytest.approx(0.01 / 1.03 * per_gain, rel=0.1)


#: No other model of a decay is fitted.
VISCOUS = 'damping = "viscous"\nstiffness = "linear"\nnoise = "white"\ndrift = "none"\n'


def test_one_logger_is_one_clock(tmp_path: Path) -> None:
    """Two decays of one logger share its drift; two loggers with equal statements have one each."""
    time = np.arange(400) / 400.0
    files = {f"{i}.csv": decay(time, i) for i in range(2)}
    loggers = "".join(f'[[instrument]]\nname = "{n}"\nclock = {{ sd = 0.1, unit = "%" }}\n' for n in ("one", "two"))
    texts = {
        names: HEAD
        + "".join(part for part in re.split(r"(?=\[\[)", loggers) if any(f'"{n}"' in part for n in names))
        + "".join(
            f'[[experiment]]\nkind = "free_vibration"\nfile = "{i}.csv"\ntime_instrument = "{name}"\n{VISCOUS}'
            for i, name in enumerate(names)
        )
        for names in (("one", "one"), ("one", "two"))
    }
    sds = {}
    for names, text in texts.items():
        result = cid.fit(cid.read_rig(write_folder(tmp_path / "_".join(names), text, files)), budget=None)
        assert {n for n in result.nuisances.index if n.startswith("clock")} == {f"clock_drift[{n}]" for n in names}
        sds[names] = result.summary.loc["k1", "sd"] / result.summary.loc["k1", "value"]
    assert sds["one", "one"] == pytest.approx(2e-3, rel=0.1)
    assert sds["one", "two"] == pytest.approx(2e-3 / np.sqrt(2.0), rel=0.15)


def decay(time: np.ndarray, seed: int) -> str:
    """A decay of 1 mm at 18 Hz in 0.11 kg, noise 1 um."""
    x = np.exp(-15.0 * time) * np.cos(113.0 * time) + 1e-3 * np.random.default_rng(seed).standard_normal(len(time))
    return "time [s],x_rel [mm]\n" + "".join(f"{t:.6f},{value:.6f}\n" for t, value in zip(time, x, strict=True))


def test_what_is_not_stated_is_said_beside_the_numbers(tmp_path: Path) -> None:
    folder, _ = bench(tmp_path / "a", 3, named=False)
    result = cid.fit(cid.read_rig(folder), budget=None)
    sentence = "the sd contains no error of gain or zero (gain: K, k2[soft], mu; zero: mu)"
    effect = f"{sentence}. An error of 1 % changes K, k2[soft] by 1 % (gain of force); mu by 1.2 % (zero of angle)."
    assert effect in " ".join(str(result).split())
    assert sentence in result._repr_html_()
    result.write(tmp_path / "out")
    saved = json.loads((tmp_path / "out" / "parameters.json").read_text(encoding="utf-8"))
    assert [text.partition(".")[0] for text in saved["not_in_sd"]] == [sentence]
    assert {name: row["not_in_sd"] for name, row in saved["parameters"].items()} == {
        "K": ["gain"], "k2[soft]": ["gain"], "mu": ["gain", "zero"],
        "m1": [], "m2": [],
    }  # fmt: skip
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("he sd contains no error of gain or zero") == 3  # beside the numbers, and in the texts to copy
    stated, _ = bench(tmp_path / "b", 3, stated=STATED)
    words = cid.fit(cid.read_rig(stated), budget=None).summary["not_in_sd"]
    assert words.to_dict() == {"K": "gain", "k2[soft]": "gain", "mu": "gain", "m1": "", "m2": ""}


REFUSED = (
    ("", 'force_instrument = "scale"', "an experiment must name an instrument of rig.toml, 'scale'"),
    ('name = "cell"\ngain = { value = 1.02, unit = "1" }', "", "a gain is a relative error"),
    ('name = "cell"\ngain = { sd = 1, half_width = 2, unit = "%" }', "", "state an error once"),
    ('name = "cell"\ngain = { sd = 1, k = 2, unit = "%" }', "", "k belongs to an expanded error"),
    ('name = "cell"\ngain = { expanded = 1, unit = "%" }', "", "add k = ..."),
    ('name = "cell"\noffset = { sd = 1, unit = "mm" }', "", "N"),
    ('name = "cell"', "", "the instrument of force of motor_current must state gain or offset"),
    (
        'name = "cell"\nclock = { sd = 1, unit = "ppm" }',
        "",
        "the instrument of force of motor_current must state gain or offset",
    ),
)


@pytest.mark.parametrize(("instrument", "setting", "words"), REFUSED)
def test_what_an_instrument_cannot_be(tmp_path: Path, instrument: str, setting: str, words: str) -> None:
    text = HEAD + (f"[[instrument]]\n{instrument}\n" if instrument else "")
    named = setting or 'force_instrument = "cell"'
    text += f'[[experiment]]\nkind = "motor_current"\nfile = "m.csv"\n{named}\n'
    folder = write_folder(tmp_path / "a", text, {"m.csv": "force [N],current [A]\n1,1\n2,2\n3.1,3\n4,4\n"})
    with pytest.raises(InputError, match=re.escape(words)):
        cid.read_rig(folder)


def test_an_instrument_that_read_nothing_is_refused(tmp_path: Path) -> None:
    folder, _ = bench(tmp_path / "a", 3, stated=STATED, named=False)
    with pytest.raises(InputError, match="the gain of an instrument must act on a column"):
        cid.read_rig(folder)


def test_a_channel_takes_the_clock_alone(tmp_path: Path) -> None:
    text = HEAD + '[[instrument]]\nname = "a"\ngain = { sd = 1, unit = "%" }\n[[experiment]]\nkind = "free_vibration"\n'
    folder = write_folder(
        tmp_path / "a", text + 'file = "d.csv"\nx_rel_instrument = "a"\n', {"d.csv": decay(np.arange(100) / 400.0, 0)}
    )
    with pytest.raises(
        InputError, match="the instrument of x_rel of free_vibration cannot be stated, only that of time"
    ):
        cid.read_rig(folder)


def test_an_error_of_what_was_measured_once_is_not_averaged(tmp_path: Path) -> None:
    """Before: a board of 950 ± 19 mm gave mu ± 0.0022, trusted; that error alone moves mu by 0.009."""
    rng = np.random.default_rng(4)
    height = 950.0 * np.sin(np.arctan(0.4)) + 3.0 * rng.standard_normal(20)
    rows = "".join(f"{h:.1f},950\n" for h in height)
    (tmp_path / "t.csv").write_text(f"height [mm],length [mm]\n{rows}")
    rig = '[rig]\nname = "r"\n[[experiment]]\nkind = "static_friction"\nfile = "t.csv"\nlength_is = "board"\n'
    (tmp_path / "rig.toml").write_text(rig + 'length_sd = { value = 19, unit = "mm" }\n')
    result = cid.fit(tmp_path, budget=None)
    (found,) = [finding for finding in result.findings if finding.code == "readings.one_value"]
    assert (found.level, found.parameters) == ("warn", ("mu",))
    lines = r'length_instrument = "of_length"|\[\[instrument\]\]|name = "[a-z_]+"|offset = \{.*?\}'
    key, table, name, offset = re.findall(lines, result.text(found))
    (tmp_path / "rig.toml").write_text("\n".join([rig + key, table, name, offset]))
    mended = cid.fit(tmp_path, budget=None)
    assert "readings.one_value" not in {finding.code for finding in mended.findings}
    assert mended.summary.loc["mu", "sd"] == pytest.approx(0.0093, rel=0.2)
