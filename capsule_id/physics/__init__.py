"""The physics of the vibro-impact capsule: knows nothing of data.

model.py     CapsuleParameters, a drive, times -> simulate -> Trajectory
friction.py  friction laws, the stick-slip rule, the slide to rest     drive.py   the force on the rod
drives/      pulses through a lag, recorded force, prescribed rod
contacts.py  the support spring                                        forces.py  rod to capsule, accelerometer
exact/       the event-driven stick-slip-contact engine                smooth/    the smoothed-Heaviside model
energy.py    energy balance of a run                                   grazing.py the load where contacts begin
series.py    polynomials of a Taylor step                              batches.py one lane axis, chunks on threads
"""
