"""``slope`` and ``N0`` of rig.toml: shared values, overrides, and each refusal with its remedy."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.rig.model import Quantity

HEAD = '[rig]\nname = "hill"\nm1 = { value = 0.11, unit = "kg" }\nm2 = { value = 0.53, unit = "kg" }\n'
SLOPE = 'slope = { value = 5, unit = "deg" }'
PULLS = '[[experiment]]\nkind = "static_friction"\nfile = "pulls.csv"\n'
TILTS = '[[experiment]]\nkind = "static_friction"\nfile = "tilts.csv"\n'
PUSHES = '[[experiment]]\nkind = "dynamic_friction"\nfile = "pushes.csv"\n'
DECAY = '[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"\n'


def written(folder: Path, *entries: str, rig: str = "") -> Path:
    (folder / "pulls.csv").write_text("force [N]\n3.1\n3.2\n")
    (folder / "tilts.csv").write_text("angle [deg]\n24\n25\n")
    (folder / "pushes.csv").write_text("speed [m/s],distance [m]\n0.3,0.01\n0.5,0.03\n")
    time = np.arange(200) / 1000.0
    rows = [f"{t:.4f},{2.0 * np.exp(-18.0 * t) * np.cos(112.0 * t):.5f}" for t in time]
    (folder / "decay.csv").write_text("\n".join(["time [s],x_rel [mm]", *rows]) + "\n")
    (folder / "rig.toml").write_text(HEAD + rig + "\n" + "\n".join(entries))
    return folder


def test_the_rig_states_them_and_an_experiment_overrides(tmp_path: Path) -> None:
    level = PUSHES + 'slope = { value = 0, unit = "deg" }\n'
    rig = read_rig(written(tmp_path, PULLS, level, TILTS, DECAY, rig=SLOPE))
    pulls, pushes, _, _ = rig.tables
    assert pulls.settings.ground == {"slope": Quantity(float(np.deg2rad(5.0)))}
    assert pushes.settings.ground == {}
    own = PULLS + 'N0 = { value = -2, unit = "N" }\nslope = { value = -3, unit = "deg" }\n'
    (pulls,) = read_rig(written(tmp_path, own, rig=SLOPE)).tables
    assert pulls.settings.ground == {"slope": Quantity(float(np.deg2rad(-3.0))), "N0": Quantity(-2.0)}


LIFTED = 'N0 = { value = -6.27, unit = "N" }'
LEVEL = 'slope = { value = 0, unit = "deg" }\n'
FAULTS = {
    # name: (entries, [rig], line of rig.toml, words of the rule, entries after the remedy, [rig] after the remedy)
    "sd": ([PULLS], 'slope = { value = 5, sd = -1, unit = "deg" }', 5, "0 or greater", [PULLS], SLOPE),
    "tilt, level to its sd": ([TILTS + 'slope = { value = 0, sd = 0.1, unit = "deg" }\n'], "", 9, "its own angle", [TILTS], ""),
    "steep": ([PULLS], 'slope = { value = 90, unit = "deg" }', 5, "between -90 and 90 deg", [PULLS], SLOPE),
    "lifted": ([PULLS], SLOPE + "\n" + LIFTED, 6, "must be positive", [PULLS], SLOPE),
    "lifted by its own": ([PULLS + LIFTED + "\n"], SLOPE, 9, "must be positive", [PULLS], SLOPE),
    "tilt": ([TILTS + SLOPE + "\n"], "", 9, "its own angle", [TILTS], ""),
    "pressed tilt": (
        [TILTS], 'N0 = { value = 1, unit = "N" }', 5, "weight alone", [TILTS + 'N0 = { value = 0, unit = "N" }\n'],
        'N0 = { value = 1, unit = "N" }',
    ),
    "both": (
        [PULLS + 'normal_force = { value = 6, unit = "N" }\nN0 = { value = 1, unit = "N" }\n'], "", 10,
        "normal_force holds N0", [PULLS + 'N0 = { value = 1, unit = "N" }\n'], "",
    ),
    "free rod": (
        [PUSHES + 'forward = "capsule"\n'], SLOPE, 5, "level ground", [PUSHES + 'forward = "capsule"\n' + LEVEL], SLOPE
    ),
    "cubic": ([DECAY + 'stiffness = "cubic"\n'], SLOPE, 5, "cubic", [DECAY + 'stiffness = "cubic"\n' + LEVEL], SLOPE),
    "free capsule": (
        [DECAY + 'capsule = "free"\n'], SLOPE, 5, "closed form",
        [DECAY + 'capsule = "free"\nforward = "capsule"\n'], SLOPE,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", list(FAULTS))
def test_what_is_not_possible_is_refused_with_a_remedy_that_works(tmp_path: Path, name: str) -> None:
    entries, rig, line, words, mended, mended_rig = FAULTS[name]
    with pytest.raises(InputError, match=words) as caught:
        read_rig(written(tmp_path, *entries, rig=rig))
    assert caught.value.line == line
    read_rig(written(tmp_path, *mended, rig=mended_rig))


def test_a_calibration_has_no_slope(tmp_path: Path) -> None:
    (tmp_path / "motor.csv").write_text("current [A],force [N]\n1,2\n2,4\n")
    motor = '[[experiment]]\nkind = "motor_current"\nfile = "motor.csv"\n'
    read_rig(written(tmp_path, motor, rig=SLOPE))
    with pytest.raises(InputError, match="unknown key"):
        read_rig(written(tmp_path, motor + SLOPE + "\n"))
