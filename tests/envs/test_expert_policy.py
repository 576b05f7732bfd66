"""Experts as policies: their velocities reach the joints."""

import gymnasium
import numpy as np
import pytest

from merl.core import MerlError
from merl.envs import make_env
from merl.envs.expert_policy import ExpertPolicy
from merl.evaluation.evaluation import evaluate


class Wrapped(gymnasium.Wrapper):
    """A wrapper that changes nothing."""


def test_evaluate_reports_that_the_expert_solves_the_task():
    env = Wrapped(make_env("lift_box", observations=("proprio",)))
    policy = ExpertPolicy(env)
    result = evaluate(policy, env, 2, reset=policy.reset)
    assert result.success_end.mean == 1.0
    assert result.returns.low > 150.0


def solves(task, seed, **form):
    env = make_env(task, observations=("proprio",), **form)
    policy = ExpertPolicy(env)
    observation, _ = env.reset(seed=seed)
    over = False
    while not over:
        observation, _, _, over, info = env.step(policy(observation))
    env.close()
    return info["success"] == 1.0


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(77002, id="box scrapes along the floor"),
        pytest.param(600006, id="fast plans need a detour"),
        pytest.param(600019, id="finger scrapes along the floor"),
    ],
)
def test_expert_solves_difficult_occluded_starts(seed):
    assert solves("move_box", seed, occluded=True)


def test_expert_keeps_a_carried_box_off_the_disc():
    assert solves("lift_box", 77053, occluded=True)


def test_actions_command_the_velocities_of_the_expert():
    env = make_env("reach_duplo", observations=("proprio",))
    policy = ExpertPolicy(env)
    observation, _ = env.reset(seed=0)
    action = policy(observation)
    assert action.dtype == np.float32
    assert env.action_space.contains(action)
    velocities = policy._expert.act()
    env.step(env.action_for(velocities))
    np.testing.assert_allclose(env.physics.data.ctrl, velocities, rtol=0, atol=1e-6)


def test_expert_works_in_an_environment_that_was_closed_and_reset():
    def actions(env, policy):
        env.reset(seed=5)
        policy.reset()
        chosen = []
        for _ in range(3):
            chosen.append(policy(None))
            env.step(chosen[-1])
        return np.array(chosen)

    env = make_env("reach_duplo", observations=("proprio",))
    policy = ExpertPolicy(env)
    expected = actions(env, policy)
    env.close()
    with pytest.raises(MerlError, match=r"call reset\(\) first"):
        policy(None)
    np.testing.assert_array_equal(actions(env, policy), expected)
    env.close()
    env.reset(seed=5)  # without policy.reset(): the expert still starts a new plan
    np.testing.assert_array_equal(policy(None), expected[0])
    env.close()


def test_other_environments_are_rejected():
    with pytest.raises(MerlError, match="there is no expert for"):
        ExpertPolicy(gymnasium.make("Pendulum-v1"))
