"""capsule-id: system identification for the vibro-impact capsule.

    rig folder -> Rig -> experiments -> log-posterior -> point fit -> emcee -> checks -> report

The public names are imported on first use, so that ``import capsule_id`` is free of JAX.
"""
