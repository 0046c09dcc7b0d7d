"""Motor force against current, which determines K."""
