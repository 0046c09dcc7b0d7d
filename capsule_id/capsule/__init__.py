"""The physics of the vibro-impact capsule: knows nothing of data.

model.py     CapsuleParameters, Excitation -> simulate -> Trajectory
exact.py     the event-driven stick-slip-contact engine        smooth.py    the smoothed-Heaviside model
batches.py   one lane axis, chunks of lanes over threads       response.py  settled motion and its label
forces.py    the forces, exact and smoothed                    bias.py      smoothed against exact, as data
periods.py   contacts and work of single periods               lyapunov.py  the largest Lyapunov exponent
sweep.py     bifurcation diagrams, maps, basins                operating.py  the same for draws of the parameters
points.py, blocks.py, attractors.py                            the points of a sweep, in blocks, and what is one motion
leaves.py    unit and meaning of every quantity                energy.py    where the drive's work goes
rosenbrock.py, march.py, march_tangents.py                     step, march and derivatives of the smoothed model
"""
