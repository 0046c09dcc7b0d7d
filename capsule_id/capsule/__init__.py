"""The physics of the vibro-impact capsule: knows nothing of data.

model.py     CapsuleParameters, Excitation -> simulate -> Trajectory
exact.py     the event-driven stick-slip-contact engine        smooth.py    the smoothed-Heaviside model
batches.py   one lane axis, chunks of lanes over threads       response.py  settled motion and its label
forces.py    the forces, exact and smoothed                    bias.py      smoothed against exact, as data
rosenbrock.py, march.py, march_tangents.py                     step, march and derivatives of the smoothed model
"""
