"""Units against hand-written factors, and wrong readings that a units library accepts by default."""

import math

import pytest

from capsule_id.rig.units import _DEFINITIONS, UnitError, factor_to_si, scale

# symbol -> (SI unit, factor), written from the SI brochure and NIST SP 811, not from the code
BY_HAND = {
    "m": ("m", 1.0),
    "mm": ("m", 0.001),
    "um": ("m", 0.000001),
    "cm": ("m", 0.01),
    "km": ("m", 1000.0),
    "in": ("m", 0.0254),
    "mil": ("m", 2.54e-5),
    "s": ("s", 1.0),
    "ms": ("s", 0.001),
    "us": ("s", 0.000001),
    "ns": ("s", 0.000000001),
    "h": ("s", 3600.0),
    "d": ("s", 86400.0),
    "stamp": ("s", 1.0),
    "min": ("s", 60.0),
    "kg": ("kg", 1.0),
    "g": ("kg", 0.001),
    "mg": ("kg", 0.000001),
    "lb": ("kg", 0.45359237),
    "A": ("A", 1.0),
    "mA": ("A", 0.001),
    "uA": ("A", 0.000001),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 0.001),
    "deg": ("rad", math.pi / 180.0),
    "rev": ("rad", 2.0 * math.pi),
    "rpm": ("rad/s", math.pi / 30.0),
    "Hz": ("Hz", 1.0),
    "kHz": ("Hz", 1000.0),
    "N": ("N", 1.0),
    "mN": ("N", 0.001),
    "uN": ("N", 0.000001),
    "kN": ("N", 1000.0),
    "gf": ("N", 0.00980665),
    "kgf": ("N", 9.80665),
    "lbf": ("N", 4.4482216152605),
    "g_n": ("m/s^2", 9.80665),
    "mg_n": ("m/s^2", 9.80665e-3),
    "Ns": ("N*s", 1.0),
    "percent": ("1", 0.01),
    "ppm": ("1", 1e-6),
}


def test_every_symbol_has_its_factor_by_hand() -> None:
    assert set(BY_HAND) == set(_DEFINITIONS)
    for symbol, (si, factor) in BY_HAND.items():
        assert factor_to_si(symbol, si) == pytest.approx(factor, rel=4e-16, abs=0.0), symbol


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("kN/m", "N/m", 1e3),
        ("N/mm", "N/m", 1e3),
        ("N s/m", "N*s/m", 1.0),
        ("N·s/m", "N*s/m", 1.0),
        ("Ns/m", "N*s/m", 1.0),
        ("kg/s", "N*s/m", 1.0),
        ("m/s^2", "m/s^2", 1.0),
        ("mm/s²", "m/s^2", 1e-3),
        ("m s⁻²", "m/s^2", 1.0),
        ("m / s / s", "m/s^2", 1.0),
        ("°", "rad", math.pi / 180.0),
        ("µm", "m", 1e-6),
        ("N/mA", "N/A", 1e3),
        ("1/s", "Hz", 1.0),
        ("deg/s", "rad/s", math.pi / 180.0),
        ("1", "1", 1.0),
        ("mm/m", "1", 1e-3),
        ("g_n s", "m/s", 9.80665),
    ],
)
def test_products_and_spellings(unit: str, si: str, factor: float) -> None:
    assert factor_to_si(unit, si) == pytest.approx(factor, rel=1e-15, abs=0.0)


@pytest.mark.parametrize(
    ("unit", "si", "rule"),
    [
        ("Hz", "rad/s", "dimension of rad/s"),  # pint's own registry lets both of these pass
        ("rad", "1", "a pure number"),
        ("rad/s", "Hz", "dimension of Hz"),
        ("deg", "m", "dimension of m"),
        ("kg", "N", "dimension of N"),
        ("mms", "m", "unknown unit symbol mms"),  # a plural of mm to pint
        ("MM", "m", "unknown unit symbol MM"),
        ("", "m", "a unit is a product"),
        ("3", "1", "a unit is a product"),
        ("2 m", "m", "a unit is a product"),
        ("m/", "m", "a unit is a product"),
        ("m^99999", "m", "a unit is a product"),
        ("__import__('os')", "m", "a unit is a product"),
        ("m*" * 30 + "m", "m", "a unit is a product"),
    ],
)
def test_refused(unit: str, si: str, rule: str) -> None:
    with pytest.raises(UnitError) as caught:
        factor_to_si(unit, si)
    assert rule in caught.value.rule
    assert caught.value.remedy.startswith("write a unit such as")


@pytest.mark.parametrize(
    ("unit", "si", "remedy"),
    [
        ("sec", "s", "write s"),  # before: "write a unit such as ms"
        ("msec", "s", "write ms"),
        ("inch", "m", "write in"),
        ("grams", "kg", "write g"),
        ("newtons", "N", "write N"),
        ("Newton/millimeter", "N/m", "write N/mm"),
        ("hz", "Hz", "write Hz"),
        ("KG", "kg", "write kg"),
        # Negative controls: no proposal of another dimension, nor across the prefixes m and M.
        ("sec", "m", "write a unit such as mm"),
        ("MN", "N", "write a unit such as N"),
        ("stone", "kg", "write a unit such as g"),
    ],
)
def test_another_name_of_a_unit_is_proposed_where_its_dimension_fits(unit: str, si: str, remedy: str) -> None:
    with pytest.raises(UnitError, match="unknown unit symbol") as caught:
        factor_to_si(unit, si)
    assert caught.value.remedy == remedy


def test_a_voltage_by_its_name_needs_a_sensitivity() -> None:
    with pytest.raises(UnitError, match="a reading in Volt needs the sensitivity"):
        factor_to_si("Volt", "m")


def test_the_same_length_in_two_units_is_the_same_float() -> None:
    millimetre = factor_to_si("mm", "m")
    assert all(scale(float(n), millimetre) == n / 1000 for n in range(2000))
    assert any(n * millimetre != n / 1000 for n in range(2000))  # what plain multiplication would do


def test_an_acceleration_in_grams_is_told_of_standard_gravity() -> None:
    with pytest.raises(UnitError, match=r"g is the gram, write g_n for standard gravity") as found:
        factor_to_si("g", "m/s^2")
    assert factor_to_si("g_n", "m/s^2") == 9.80665, found.value.remedy
    assert factor_to_si("g", "kg") == 1e-3
