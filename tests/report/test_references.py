"""What returns are compared with."""

import pytest

from merl.envs.config import EnvConfig
from merl.report.references import references


def test_every_task_has_a_floor_and_a_ceiling():
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
        assert sum(expert.terms.values()) == pytest.approx(expert.returns.mean, abs=0.3)
        assert max(chance.returns.high, still.returns.high) < expert.returns.low
        assert expert.success_end is not None
        assert expert.success_end.mean >= 0.95
        assert still.success_end is not None
        assert still.success_end.mean < 0.05


def test_what_is_published_says_where():
    published = references("reach_duplo")[-1]
    assert (published.name, published.returns.mean) == ("best known: DrQ-v2", 224.6)
    assert "published" in published.source


def test_a_task_of_ones_own_has_none():
    assert references("my_package:make_env") == ()


@pytest.mark.parametrize(
    "form", [EnvConfig(start=("around",)), EnvConfig(occluded=True, reward="staged")]
)
def test_a_form_that_was_not_measured_has_none(form):
    assert references("move_box", form) == ()
