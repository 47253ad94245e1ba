"""Garments for the tests of this folder."""

import pytest

from onefit.body import AnnyBody
from onefit.garment import TEMPLATES, Garment, standard_body
from onefit.garment.charts import PatchedGarment
from onefit.garment.sewing.block import Block


@pytest.fixture(scope="session")
def templates():
    return {name: Garment.template(name) for name in TEMPLATES}


@pytest.fixture(scope="session")
def tank(templates):
    g = templates["tank"]
    return g.vertices.double().numpy(), g.faces.numpy()


@pytest.fixture(scope="session")
def block():
    """Twice as coarse as it is sewn on, several times as fast."""
    body = standard_body()
    return Block(body.vertices.numpy(), body.faces.numpy(), spacing=0.016)


@pytest.fixture(scope="session")
def anny():
    return AnnyBody()


@pytest.fixture(scope="session")
def body():
    return AnnyBody().body()


@pytest.fixture(scope="session")
def garment():
    return Garment.template("tank")


@pytest.fixture(scope="session")
def patched(garment, body):
    return PatchedGarment(garment, body)
