"""The settled motion in one line: period, direction, contacts, mean velocity, and the paper's label P-<n>-<F|B|S>-<m>.

simulate over DROPPED + OBSERVED periods -> Poincaré section -> period -> contacts of each period -> Response
"""

from dataclasses import dataclass
from fractions import Fraction

import jax
import numpy as np

from capsule_id.capsule.batches import is_traced, lanes_of
from capsule_id.capsule.model import MAX_STEPS, CapsuleParameters, Excitation, Status, simulate
from capsule_id.errors import InputError

# Excitation periods left out, and looked at.
DROPPED, OBSERVED = 300, 48
# The longest period that is looked for, in excitation periods.
LONGEST = 16
# Two points of the Poincaré section are the same within these (m, m/s), and within this part of the motion's size.
SAME_POSITION, SAME_VELOCITY, SAME_RELATIVE = 1e-7, 1e-4, 1e-3
# A capsule that advances less than this per excitation period (m) stands still.
STANDING = 1e-7


@dataclass(frozen=True)
class Response:
    """The settled motion; with a batch every field is an array (batch,).

    label : "P-<period>-<direction>-<contacts>", "aperiodic", or "failed" where the run was given up (see status)
    period : in excitation periods, 1..16; 0 where the motion is aperiodic or the run failed
    direction : "F" forward, "B" backward, "S" standing (|advance| < 1e-7 m per excitation period), "" where failed
    contacts_per_period : closings of the gap per excitation period
    mean_velocity : of the capsule over the observed periods, m/s
    status : a ``Status`` code
    """

    label: str | np.ndarray
    period: int | np.ndarray
    direction: str | np.ndarray
    contacts_per_period: float | np.ndarray
    mean_velocity: float | np.ndarray
    status: int | np.ndarray


def response(p: CapsuleParameters, e: Excitation, *, max_steps: int = MAX_STEPS) -> Response:
    """Settled motion from rest: 300 excitation periods dropped, 48 observed.

    Parameters
    ----------
    p, e : parameters and drive; any leaf may carry a batch axis (batch,). Omega must be positive.
    max_steps : bound on the steps of a lane, see ``simulate``

    Raises
    ------
    InputError
        Traced values (a label is a string), Omega not positive, shapes that do not agree.
    """
    if is_traced((p, e)):
        raise InputError("response needs concrete values", "a traced value", "call it outside of jit, vmap and jvp")
    ((p, e), _), batched = lanes_of((p, e), np.zeros(1))
    if not np.all(np.asarray(e.Omega) > 0.0):
        raise InputError("Omega must be positive", str(e.Omega), "a response needs a period: use simulate")
    T = 2.0 * np.pi / np.asarray(e.Omega)
    periods = np.arange(DROPPED, DROPPED + OBSERVED + 1)
    run = simulate(p, e, T[:, None] * np.concatenate([[0], periods]), max_steps=max_steps)
    state = np.stack([np.asarray(x)[:, 1:] for x in (run.X1, run.Y1, run.X2, run.Y2)])
    contacts, contact_status = _contacts(p, e, T[:, None] * periods, state, max_steps)
    status = np.maximum(np.asarray(run.status), contact_status)
    found = [_describe(state[:, i], 2.0 * np.pi / T[i], contacts[i], int(status[i])) for i in range(len(T))]
    label, period, direction, per_period = (list(column) for column in zip(*found, strict=True))
    velocity = (state[2, :, -1] - state[2, :, 0]) / (OBSERVED * T)
    if not batched:
        return Response(label[0], period[0], direction[0], per_period[0], float(velocity[0]), int(status[0]))
    return Response(np.array(label), np.array(period), np.array(direction), np.array(per_period), velocity, status)


def _contacts(
    p: CapsuleParameters, e: Excitation, times: np.ndarray, state: np.ndarray, max_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """(closings in each period (lanes, OBSERVED), gravest status (lanes,)): every period is a lane of its own."""
    lanes = times.shape[0]
    start = tuple(np.nan_to_num(x[:, :-1]).ravel() for x in state)
    p, e = jax.tree.map(lambda leaf: np.repeat(leaf, OBSERVED), (p, e))
    span = np.stack([times[:, :-1].ravel(), times[:, 1:].ravel()], axis=1)
    run = simulate(p, e, span, start, max_steps=max_steps)
    contacts, status = (np.asarray(x).reshape(lanes, OBSERVED) for x in (run.contacts, run.status))
    return contacts, status.max(axis=1)


def _describe(state: np.ndarray, Omega: float, contacts: np.ndarray, status: int) -> tuple[str, int, str, float]:
    """(label, period, direction, contacts per period) of one lane: state (4, OBSERVED + 1), contacts (OBSERVED,)."""
    if not Status(status).usable:
        return "failed", 0, "", float("nan")
    X1, Y1, X2, Y2 = state
    advance = (X2[-1] - X2[0]) / OBSERVED
    direction = "S" if abs(advance) < STANDING else "F" if advance > 0.0 else "B"
    period = period_of(X1 - X2, Y1 - Y2, Omega)
    if period == 0:
        return "aperiodic", 0, direction, float(contacts.mean())
    whole = OBSERVED // period * period
    per_period = Fraction(int(contacts[-whole:].sum()), whole)
    return f"P-{period}-{direction}-{per_period}", period, direction, float(per_period)


def period_of(x_rel: np.ndarray, rate: np.ndarray, Omega: float) -> int:
    """Period in excitation periods of points (n,) of the Poincaré section (m, m/s); 0 if they do not repeat.

    The tolerance is absolute, and for small motions relative to the largest distance from the origin.
    """
    scale = SAME_RELATIVE * float(np.max(np.hypot(x_rel, rate / Omega)))
    for n in range(1, LONGEST + 1):
        dx, dw = np.abs(x_rel[n:] - x_rel[:-n]), np.abs(rate[n:] - rate[:-n])
        if dx.max() <= min(SAME_POSITION, scale) and dw.max() <= min(SAME_VELOCITY, scale * Omega):
            return n
    return 0
