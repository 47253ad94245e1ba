from dataclasses import fields, replace

import pytest
import torch

import onefit
from onefit.contact import ContactSettings
from onefit.objective import crossings
from onefit.physics import Settings


@pytest.fixture(scope="module")
def draper():
    return onefit.load()


@pytest.fixture(scope="module")
def draped(draper):
    motion = onefit.Motion.generate("dance", seconds=0.1, seed=1_000_003)
    make = lambda **how: draper.simulate("shorts", motion, settings=Settings(settling=0.1, **how))
    return {
        "network": draper.drape("shorts", motion),
        "simulated": make(lead=0.3),
        "at once": make(lead=0.0),
    }


def test_a_simulation_begins_as_the_garment_was_made_not_as_the_network_folds_it(draped):
    of = lambda name: crossings(draped[name].vertices[0].numpy(), draped[name].faces.numpy())
    assert of("network") > 10
    assert of("simulated") == 0
    assert of("at once") > 0  # what has passed through stays


def test_what_leads_to_the_first_frame_is_not_given(draped):
    network = draped["network"]
    for name in ("simulated", "at once"):
        drape = draped[name]
        assert drape.vertices.shape == network.vertices.shape
        assert (drape.root == network.root).all()
        yielded = (drape.body - network.body).norm(dim=-1)  # where limbs and trunk meet
        assert yielded.max() < 0.02 and (yielded > 0).float().mean() < 0.1
        far = (drape.vertices - network.vertices).norm(dim=-1)
        assert 1e-3 < far.mean() < 0.03
        assert drape.measures().collision == 0


def test_a_simulation_reads_every_number_of_contact(draper):
    motion = onefit.Motion.generate("squat", seconds=0.1)
    worn = [onefit.Garment.template("trousers").remeshed(300)] * 2
    settings = Settings(settling=0, lead=0)

    def simulated(contact):
        drapes = draper.simulate(worn, motion, settings=replace(settings, contact=contact))
        return torch.cat([drape.vertices for drape in drapes], 1)

    standard = ContactSettings()
    plain = simulated(standard)
    for field in fields(standard):
        changed = replace(standard, **{field.name: 0.5 * getattr(standard, field.name)})
        assert not torch.equal(simulated(changed), plain), field.name
