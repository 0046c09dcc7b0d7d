"""The subcommands of `capsule-id`, a file each: ``add_arguments(parser)`` and ``run(args) -> exit code``."""
