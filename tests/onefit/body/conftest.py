"""Bodies for the tests of this folder."""

import pytest

from onefit.body import AnnyBody


@pytest.fixture(scope="session")
def model():
    return AnnyBody()


@pytest.fixture(scope="session")
def standard(model):
    return model.body()
