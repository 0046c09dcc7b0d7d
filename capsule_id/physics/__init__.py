"""The physics of the vibro-impact capsule: knows nothing of data.

model.py     CapsuleParameters, Excitation -> simulate -> Trajectory
exact/       the event-driven stick-slip-contact engine        smooth/    the smoothed-Heaviside model
batches.py   one lane axis, chunks of lanes over threads       energy.py  where the drive's work goes
forces.py    the forces, exact and smoothed                    leaves.py  unit and meaning of every quantity
"""
