"""The physics of the vibro-impact capsule: knows nothing of data.

model.py       CapsuleParameters, a drive, times -> Trajectory       drives.py   further drives
forces.py      friction laws and forces, on numbers, arrays and series; the slide to rest
exact/         the event-driven stick-slip-contact engine            smooth/     the smoothed-Heaviside model
simulation.py  a run by either engine, its energy balance, displacements of many runs
batches.py     one lane axis, chunks on threads
"""

from capsule_id.precision import require_float64

require_float64()
