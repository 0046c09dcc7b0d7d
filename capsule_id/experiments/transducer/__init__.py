"""Reading of a force transducer against a known force, which determines its sensitivity."""
