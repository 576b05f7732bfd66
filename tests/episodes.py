"""Episodes of a task without an environment, for the tests of tasks and experts."""

import numpy as np

from merl.tasks import arm_task, make_task


class Episodes:
    """A task, started as in `ArmEnv`: one physics for all episodes."""

    def __init__(self, name, occluded=False, **form):
        self.name, self.occluded = name, occluded
        self.task = make_task(name, occluded=occluded, **form)
        self.physics = self.task.compile()

    def start(self, seed):
        self.task.start_episode(self.physics, np.random.RandomState(seed))
        return self.physics


def check_starts(episodes, seeds, resting_height):
    """Check that each start is in its region and at rest, and that the robot touches nothing.

    Returns:
        For each start, the object's yaw, rad, and the closed fraction of the fingers.
    """
    task = episodes.task
    yaws, closures = [], []
    for seed in seeds:
        physics = episodes.start(seed)
        hand, prop = task.robot.tool_center_point(physics), task.prop_position(physics)
        assert (hand >= np.array(arm_task.HAND_SPAWN.lower) - 0.002).all()
        assert (hand <= np.array(arm_task.HAND_SPAWN.upper) + 0.002).all()
        assert (np.abs(prop[:2]) <= 0.101).all()
        assert abs(prop[2] - resting_height) < 1e-3
        down = physics.bind(task.robot.hand.tool_center_point).xmat.reshape(3, 3)[:, 2]
        assert abs(down[2] + 1.0) < 0.01
        robot = set(physics.bind(task.robot.arm.mjcf_model.find_all("geom")).element_id)
        for contact in physics.data.contact:
            pair = {contact.geom1, contact.geom2}
            assert not pair & robot or pair <= robot
        w, _, _, z = physics.data.qpos[-4:]
        yaws.append(2 * np.arctan2(z, w) % (2 * np.pi))
        low, high = physics.bind(task.robot.hand.joints).range.T
        closures.append(((physics.bind(task.robot.hand.joints).qpos - low) / (high - low)).mean())
    return np.array(yaws), np.array(closures)


def check_uniform(yaws, closures):
    """Check 500 yaws and closures: about 100 of them must be in each fifth of their range."""
    for share in (yaws / (2 * np.pi), closures):
        assert np.histogram(share, bins=5, range=(0, 1))[0].min() > 60
