"""The physics of the vibro-impact capsule: knows nothing of data.

model.py     CapsuleParameters, a drive, times -> simulate -> Trajectory
friction.py  friction laws, on numbers, arrays and series; the slide to rest
forces.py    support spring, rod to capsule, accelerometer     drive.py, drives.py   the force on the rod
exact/       the event-driven stick-slip-contact engine        smooth/   the smoothed-Heaviside model
energy.py    energy balance of a run                           displacement.py   displacements of many runs
batches.py   one lane axis, chunks on threads
"""

from capsule_id.precision import require_float64

require_float64()
