"""Numbers are rounded to their uncertainty and names set by rule."""

import math

import pytest

from capsule_id.report.columns import decimals_for, fixed, plain_symbol, prefix_for, symbol_parts


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (1421.347, 3.14, "1421.3"),
        (1421.347, 31.4, "1421"),
        (56410.0, 123.0, "56410"),
        (56415.0, 1234.0, "56400"),
        (0.66031, 0.00614, "0.6603"),
        (0.5, 0.0996, "0.50"),  # 0.0996 is 0.10 with two digits
        (0.5, 9.96, "0"),
        (-2.0, 0.25, "-2.00"),
        (3.14159265, 0.0, "3.14159"),  # nothing to round to
        (3.14159265, math.nan, "3.14159"),
        (math.nan, 0.1, "–"),
    ],
)
def test_rounding_keeps_two_digits_of_the_sd(value: float, sd: float, text: str) -> None:
    assert fixed(value, decimals_for(sd)) == text


@pytest.mark.parametrize("sd", [10.0 ** (0.137 * k) for k in range(-60, 60)])
def test_rounding_error_is_below_a_tenth_of_the_sd(sd: float) -> None:
    value = math.pi * 1e3 * sd
    shown = float(fixed(value, decimals_for(sd)))
    assert abs(shown - value) <= 0.05 * sd * (1 + 1e-9)


@pytest.mark.parametrize(
    ("unit", "magnitude", "factor", "shown"),
    [
        ("m", 2e-5, 1e6, "µm"),
        ("m", 2e-4, 1e6, "µm"),
        ("N/m", 56410.0, 1.0, "N/m"),
        ("N/m", 2.5e7, 1e-6, "MN/m"),
        ("kg", 1e-5, 1.0, "kg"),  # has a prefix already
        ("1", 1e-5, 1.0, "1"),
        ("m^2", 1e-8, 1.0, "m^2"),  # (µm)^2 would be another number
        ("m/s", 0.0, 1.0, "m/s"),
        ("m", math.nan, 1.0, "m"),
        ("rad", 1e-4, 1e6, "µrad"),
    ],
)
def test_decimal_prefix(unit: str, magnitude: float, factor: float, shown: str) -> None:
    scale, name = prefix_for(unit, magnitude)
    assert name == shown
    assert scale == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("unit", "magnitudes", "shown"),
    [
        ("m", (1.0004e-3, 0.9997e-3), "mm"),
        ("m", (5.0, 2e-5), "mm"),  # 5000 and 0.02
        ("m", (2e-5, 0.0, math.nan), "µm"),
        ("N/m", (1420.0, 56410.0), "N/m"),
        ("N/m", (1420.0, 2.5e7), "kN/m"),
        ("kg", (1e-5, 1e9), "kg"),
    ],
)
def test_numbers_of_one_unit_share_a_prefix_in_which_each_is_readable(
    unit: str, magnitudes: tuple[float, ...], shown: str
) -> None:
    scale, name = prefix_for(unit, *magnitudes)
    assert name == shown
    if unit != "kg":
        assert all(1e-2 <= scale * size < 1e7 for size in magnitudes if size > 0.0)


@pytest.mark.parametrize(
    ("name", "parts", "plain"),
    [
        ("k1", ("k", "1", ""), "k₁"),
        ("c", ("c", "", ""), "c"),
        ("mu", ("μ", "", ""), "μ"),
        ("v_s", ("v", "s", ""), "vₛ"),
        ("Omega", ("Ω", "", ""), "Ω"),
        ("P_d", ("P", "d", ""), "P_d"),
        ("k2[soft]", ("k", "2", "soft"), "k₂ soft"),
        ("noise_x_rel[run_1]", ("noise_x_rel", "", "run_1"), "noise_x_rel run_1"),
        ("tilt_sd", ("tilt_sd", "", ""), "tilt_sd"),
        ("k2[<b>$x$]", ("k", "2", "<b>$x$"), "k₂ <b>$x$"),
        ("2 odd[x", ("2 odd", "", "x"), "2 odd x"),
    ],
)
def test_symbols(name: str, parts: tuple[str, str, str], plain: str) -> None:
    assert symbol_parts(name) == parts
    assert plain_symbol(name) == plain


def test_long_labels_are_cut() -> None:
    assert plain_symbol(f"k2[{'x' * 100}]") == "k₂ " + "x" * 23 + "…"
