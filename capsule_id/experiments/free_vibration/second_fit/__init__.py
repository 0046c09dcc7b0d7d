"""Second fit of free decays whose record contradicts the stated model."""
