"""The reference returns of the tasks."""

import pytest

from merl.envs.config import EnvConfig
from merl.report.references import references


def test_every_task_has_random_actions_no_motion_and_an_expert():
    for task, form in [
        ("reach_duplo", EnvConfig()),
        ("move_box", EnvConfig()),
        ("lift_box", EnvConfig()),
        ("move_box", EnvConfig(occluded=True)),
        ("lift_box", EnvConfig(occluded=True)),
        ("move_box", EnvConfig(reward="staged")),
        ("lift_box", EnvConfig(reward="staged")),
    ]:
        rows = {row.name: row for row in references(task, form)}
        chance, still, expert = (
            rows[name] for name in ("random actions", "no motion", "scripted expert")
        )
        assert chance.returns.low <= chance.returns.mean <= chance.returns.high
        assert max(chance.returns.high, still.returns.high) < expert.returns.low
        assert expert.success_end is not None
        assert expert.success_end.mean >= 0.95
        assert still.success_end is not None
        assert still.success_end.mean < 0.05


def test_published_references_name_their_source():
    published = references("reach_duplo")[-1]
    assert (published.name, published.returns.mean) == ("best known: DrQ-v2", 224.6)
    assert "published" in published.source


def test_episodes_that_are_cut_off_have_no_references():
    assert references("reach_duplo", limit=249) == ()


def test_a_user_task_has_no_references():
    assert references("my_package:make_env") == ()


@pytest.mark.parametrize(
    "form", [EnvConfig(start=("around",)), EnvConfig(occluded=True, reward="staged")]
)
def test_an_unmeasured_form_has_no_references(form):
    assert references("move_box", form) == ()
