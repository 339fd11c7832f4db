"""The tree of models: each is a file, a refusal is logged, and the last step can be undone."""

import msgspec
import pytest

from socast.core import models
from socast.core.diagnose.add.add import AdditionTrial, log_attempt
from socast.core.diagnose.add.records import ADDED, REFUSED, EffectTrial
from socast.core.errors import SettingsError
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.tools.workbench.loop.model_tree import ModelTree


def make_trial(base, effect, *, accepted=True):
    """Return a trial of an effect whose model differs from its base in the name only."""
    trial = EffectTrial(
        action=ADDED if accepted else REFUSED,
        effect=effect,
        accepted=accepted,
        reason="chance",
        from_version=base.version,
    )
    grown = msgspec.structs.replace(log_attempt(base, trial), name=f"{base.name} with {effect}")
    return AdditionTrial(models.stamp(grown), trial)


@pytest.fixture
def tree(tmp_path):
    """A tree with one model."""
    grown = ModelTree(tmp_path / "models")
    grown.insert("base", BASIC_PHYSICAL)
    return grown


def add(tree, name, effect, **options):
    """Insert the trial of an effect, and return the model after it."""
    return tree.insert_trial(name, make_trial(tree.find(name).model, effect, **options))


def test_each_model_is_a_file(tree):
    added = add(tree, "base", "headwind")
    assert added.name == "base-headwind"
    assert models.load(added.file).version == added.model.version


def test_two_effects_added_to_one_model_are_branches(tree):
    add(tree, "base", "headwind")
    add(tree, "base", "snow")
    assert [(record["name"], record["parent"]) for record in tree.list_records()] == [
        ("base", ""),
        ("base-headwind", "base"),
        ("base-snow", "base"),
    ]


def test_variant_of_an_effect_gives_a_plain_name(tree):
    assert add(tree, "base", "cold_rolling@reference=283.15").name == "base-cold_rolling"


def test_refused_effect_is_logged_and_the_model_stays(tree):
    after = add(tree, "base", "cornering", accepted=False)
    assert after.name == "base"
    assert after.model.version == tree.find("base").model.version
    assert models.load(after.file).history[-1]["effect"] == "cornering"
    assert tree.list_records()[0]["tried"] == {"refused": 1, "undecided": 0}


def test_undo_removes_the_last_model_and_its_file(tree):
    added = add(tree, "base", "headwind")
    assert tree.remove(added.name) == "base"
    assert not added.file.exists()
    assert tree.names == ["base"]


def test_model_with_others_made_of_it_is_not_undone(tree):
    add(tree, "base", "headwind")
    add(tree, "base-headwind", "snow")
    with pytest.raises(SettingsError, match="undo that first"):
        tree.remove("base-headwind")


def test_given_model_is_not_undone(tree):
    with pytest.raises(SettingsError, match="nothing to undo"):
        tree.remove("base")


def test_same_model_given_twice_is_one(tree):
    assert tree.insert("again", BASIC_PHYSICAL).name == "base"
    assert tree.insert("base", EXTENDED_PHYSICAL).name == "base-2"


def test_name_that_is_no_file_name_is_cleaned(tmp_path):
    node = ModelTree(tmp_path).insert("../my model", BASIC_PHYSICAL)
    assert node.file.parent == tmp_path
    assert "/" not in node.name


def test_unknown_name_is_refused_with_the_known_ones(tree):
    with pytest.raises(SettingsError, match="choose from base"):
        tree.find("other")
