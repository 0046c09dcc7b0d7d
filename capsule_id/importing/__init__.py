"""The import assistant: guesses what an export holds, writes the ``rig.toml`` that reads it, describes it."""
