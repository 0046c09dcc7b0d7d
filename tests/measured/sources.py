"""Records that other people measured, read from where they are kept beside the repository; never part of it.

Several of them are rotary or come in other units than a rig folder knows. They are relabelled, and each test says how:
the numbers stay, a radian is written "m", a moment of inertia "kg", a count "N", a pound "A".
"""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

_FOLDER = Path(__file__).parents[2].parent / "shared" / "measured"


def measured_file(name: str) -> Path:
    """The measured file; the test is skipped where the collection is not at hand (it is not ours to pass on)."""
    path = _FOLDER / name
    if not path.is_file():
        pytest.skip("the measured records are not passed on with the package; they stand beside its author's checkout")
    return path


def ship_roll(run: int = 21337) -> tuple[np.ndarray, np.ndarray]:
    """KVLCC2 model, run 21337 or 21338: time, s, and roll angle, rad, (n,) each; lead-in before the release included."""
    data = np.genfromtxt(measured_file(f"kvlcc2_roll/model_test_{run}.csv"), delimiter=",", names=True)
    return data["time"], data["phi"]


def ship_roll_stiffness() -> float:
    """Hydrostatic roll stiffness m g GM of the model, N m/rad, from its parameter sheet: independent of the decay."""
    with measured_file("kvlcc2_roll/model_test_parameters.csv").open(newline="", encoding="utf-8") as file:
        row = next(row for row in csv.DictReader(file) if row["id"] == "21337")
    volume, height, scale, rho, g = (float(row[key]) for key in ("Volume", "gm", "scale_factor", "rho", "g"))
    return rho * volume / scale**3 * g * height / scale


def pendulum(record: int) -> tuple[np.ndarray, np.ndarray]:
    """Free swing 1, 2 or 3 (released at 90, 135, 45 deg): time, s, from the first sample, and angle, rad."""
    path = measured_file(f"pendulum_jensen/pendulum_free_swing_data_{record:02d}.txt")
    rate = float(path.read_text(encoding="utf-8").splitlines()[1].split(",")[1])
    angle = np.deg2rad(np.loadtxt(path, skiprows=2))
    return np.arange(angle.size) / rate, angle


def counted_pendulum(length: int) -> tuple[np.ndarray, np.ndarray]:
    """Swing of a string of 20 or 29 cm, read by an encoder: time, s, unevenly spaced, and angle, rad, (n,) each."""
    return tuple(np.loadtxt(measured_file(f"pendulum_phy180/L{length}.csv"), delimiter=",", skiprows=1).T)


def coil_spring() -> tuple[np.ndarray, np.ndarray]:
    """Deflection, cm, and added mass, g, (10,) each, in the order of the file."""
    return tuple(
        np.loadtxt(measured_file("hooke_spring_skcpr/spring_defl_vs_added_mass.csv"), delimiter=",", skiprows=1).T
    )


def frame(load: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, s, and displacements of the storey and of the base of the shaken frame, m, (n,) each; load "350g" or "450g"."""
    storey, base = (loadmat(measured_file(f"frame_marino/s_b_{load}_{name}.mat")) for name in "xy")
    return storey["t"].ravel(), 1e-3 * storey["x"].ravel(), 1e-3 * base["y"].ravel()


def load_cells() -> tuple[np.ndarray, np.ndarray]:
    """Time, s, (n,) and counts of both cells, (n, 2), of the calibration with 0-10-20-30-40-30-20-10-0 lb."""
    data = np.genfromtxt(measured_file("loadcell_cie324/LoadCellCalibrationData.txt"), delimiter=",")
    return 1e-3 * (data[:, 0] - data[0, 0]), data[:, 10:12]


def tilt_notes() -> str:
    """The notes with heights at sliding and board lengths, cm."""
    return measured_file("tilt_upright/object-parameters_2fb69b9.ql").read_text(encoding="utf-8")


def rack_friction() -> tuple[np.ndarray, np.ndarray]:
    """Speed, m/s, and friction coefficient of a rack-and-pinion drive, (6,) averages each."""
    return tuple(np.loadtxt(measured_file("rack_friction_mnich/slide.csv"), delimiter=",", skiprows=1).T)
