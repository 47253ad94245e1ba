"""The table of what each rule is worth: rules are switched off, results are kept and read right."""

import dataclasses
import json

import pytest
import synthetic
from scripts import load

from polysft_mi import prepare
from polysft_mi.scene.rules import Rules
from polysft_mi.scene.settings import Settings

ablation = load("benchmarks/ablation.py")
results_of = load("benchmarks/ablation_results.py")


def results(**errors):
    """Results of rules on sequences 0, 1, ...: rule = errors."""
    return {
        (rule, k): {"figures": {"e3d_proc": error}, "lost": 0, "cpu": 1.0}
        for rule, values in errors.items()
        for k, error in enumerate(values)
    }


@pytest.mark.parametrize("switch", ablation.SWITCHES[1:], ids=lambda s: s.rule)
def test_every_switch_changes_what_is_there(switch):
    for values, defaults in ((switch.fields, Rules()), (switch.settings, Settings())):
        for name, value in values.items():
            assert getattr(defaults, name) != value
    assert switch.fields or switch.settings or switch.chance


def test_each_rule_names_the_row_that_switches_it_off():
    named = {f.name: f.metadata["row"] for f in dataclasses.fields(Rules)}
    assert named == {name: s.rule for s in ablation.SWITCHES for name in s.fields}


def test_a_rule_that_pays_on_two_sequences_stays():
    found = results(twice=(1.2, 1.06, 0.9), once=(1.2, 1.04, 1.0))
    found |= results(**{results_of.BASELINE: (1.0, 1.0, 1.0)})
    verdict = lambda rule: results_of.verdict(found, rule, (0, 1, 2))
    assert verdict("twice") == "pays on 2 of 3; stays"
    assert verdict("once") == "pays on 1 of 3; goes"
    assert results_of.decided(found, "twice") and not results_of.decided(found, "once")
    del found["twice", 2], found["once", 2]
    assert verdict("twice") == "pays on 2 of 2; stays"  # whatever the third says
    assert verdict("once") == "pays on 1 of 2"


def test_what_chance_does_too_does_not_count():
    one, two = list(results_of.CHANCES)[:2]
    found = results(rule=(1.2, 1.2)) | results(**{results_of.BASELINE: (1.0, 1.0)})
    found |= results(**{one: (0.9, 1.0), two: (1.1, 1.3)})
    assert results_of.verdict(found, "rule", (0, 1)) == "pays on 1 of 2; goes"
    found = {(rule, f"sequence {k}"): result for (rule, k), result in found.items()}
    table = results_of.table(found, ["rule"], ("sequence 0", "sequence 1")).splitlines()
    assert table[2] == "| none | -10 to +10 | +0 to +30 | – | what chance does |"
    assert table[3].startswith("| rule | +20 | +20 |")


def test_the_switch_reaches_the_tracker(tmp_path):
    truth = synthetic.cloth(tmp_path / "flag", frames=2, bend=1.0, turn=0.02, shift=0.002)
    prepare.main([str(truth.folder)])
    scene = str(truth.folder / "scene.xml")
    figures = lambda *switch: ablation.run(ablation.Switch(*switch), scene, str(truth.folder))
    usual = figures("usual")["figures"]
    assert figures("again")["figures"] == usual
    assert figures("a rule", {"iterations": (1, 1, 1)})["figures"] != usual
    assert figures("a setting", {}, {"k_relief": 0})["figures"] != usual


def test_page_is_made_from_the_file(tmp_path):
    found = [
        {"rule": rule, "sequence": "flag 91", "figures": {"e3d_proc": e}, "lost": 0, "cpu": 1.0}
        for rule, e in ((results_of.BASELINE, 0.001), ("relief", 0.002))
    ]
    (tmp_path / "ablation.json").write_text(json.dumps({"results": found}))
    known = results_of.read(str(tmp_path / "ablation.json"))
    text = results_of.page(known, ablation.SWITCHES, ablation.ORDER)
    assert "| relief | +100 | +0 | pays on 1 of 1; goes |" in text
    unknown = text[text.index("Not measured") : text.index("With all rules on")]
    assert "appearance" in unknown and "relief's bending" in unknown and "relief," not in unknown


def test_what_was_measured_before_has_a_table_of_its_own():
    there = "flag" + results_of.BEFORE
    found = {
        (rule, name): {"figures": {"e3d_proc": error}, "lost": 0, "cpu": 1.0}
        for rule, name, error in (
            *((results_of.BASELINE, name, 0.001) for name in ("flag 91", "bend 92", there)),
            *(("relief", name, 0.002) for name in ("flag 91", "bend 92", there)),
            *(("damping", name, 0.002) for name in ("flag 91", there)),
            ("edges give", there, 0.003),
        )
    }
    text = results_of.page(found, ablation.SWITCHES, ablation.ORDER)
    now, before = text.split("## Before")
    assert "| relief | +100 |" in now and "| edges give |" not in now
    assert "| edges give | +200 |" in before
    assert "| damping | +100 | – |" in now and "| damping | +100 |" in before  # not decided yet
    assert "| relief |" not in before
