"""Fixtures for the capsule's tests."""

import pytest

from tests.capsule_cases import Cases, read_cases


@pytest.fixture(scope="session")
def cases() -> Cases:
    """The 25 reference cases as one batch."""
    return read_cases()
