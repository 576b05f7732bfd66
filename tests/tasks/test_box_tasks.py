"""move_box and lift_box: starts, rewards in the simulation, visibility to the camera."""

import numpy as np
import pytest
from dm_control import composer

from episodes import Episodes, check_starts, check_uniform
from merl.core import MerlError
from merl.rendering.raster.renderer import RasterRenderer
from merl.tasks import BOX_TASKS, TASKS, arm_task, make_task, rewards
from merl.tasks.box import AROUND_BOX, BOX_HALF_SIZE, BOX_MASS
from merl.tasks.expert import make_expert
from merl.tasks.kinematics import Pose
from merl.tasks.planner import GRIP, SERVO_GAIN

FORMS = [("move_box", False), ("lift_box", False), ("move_box", True), ("lift_box", True)]


@pytest.fixture(scope="module", params=FORMS, ids=lambda p: p[0] + "-occluded" * p[1])
def episodes(request):
    return Episodes(*request.param)


def put_box(episodes, position):
    episodes.physics.data.qpos[-7:] = (*position, 1.0, 0.0, 0.0, 0.0)
    episodes.physics.forward()


class Segmentation:
    """A counter of the pixels of geoms in the image of the tasks' camera."""

    def __init__(self, physics, size):
        self._renderer = RasterRenderer(physics, arm_task.CAMERA.name, size)

    def pixels(self, geom):
        return int((self._renderer.render_segmentation() == geom).sum())


def box_geom(episodes):
    return int(episodes.physics.bind(episodes.task.prop.geom).element_id)


def test_starts_are_in_their_regions_and_without_contact(episodes):
    check_starts(episodes, range(10), BOX_HALF_SIZE)


@pytest.mark.long
def test_yaw_and_finger_closure_at_the_start_are_uniform(episodes):
    check_uniform(*check_starts(episodes, range(500), BOX_HALF_SIZE))


def check_starts_equal_recompiled_ones(episodes, seeds):
    """Check that starts 1 and 10 equal those of an environment that compiles in every episode."""
    task = make_task(episodes.name, occluded=episodes.occluded)
    slow = composer.Environment(task, time_limit=10.0)
    for seed in seeds:
        slow._random_state = np.random.RandomState(seed)
        slow.reset()
        expected = slow.physics.data
        for start in range(10):
            physics = episodes.start(seed if start in (0, 9) else seed + 1000 * start)
            if start in (0, 9):
                np.testing.assert_allclose(physics.data.qpos, expected.qpos, rtol=0, atol=1e-6)
                np.testing.assert_allclose(physics.data.qvel, expected.qvel, rtol=0, atol=1e-6)
    slow.close()


def test_starts_equal_those_of_a_recompiled_model(episodes):
    check_starts_equal_recompiled_ones(episodes, range(2))


@pytest.mark.long
def test_100_starts_equal_those_of_a_recompiled_model(episodes):
    check_starts_equal_recompiled_ones(episodes, range(100))


def test_box_target_and_state(episodes):
    physics, task = episodes.start(0), episodes.task
    geom = physics.bind(task.prop.geom)
    assert physics.model.body_mass[physics.model.geom_bodyid[geom.element_id]] == BOX_MASS == 0.1
    np.testing.assert_array_equal(geom.size, 3 * [0.025])
    target = {"move_box": (0.0, -0.2, 0.025), "lift_box": (0.0, 0.0, 0.18)}[episodes.name]
    if (episodes.name, episodes.occluded) == ("lift_box", True):
        target = (0.0, 0.0, 0.22)
    np.testing.assert_array_equal(task.target, target)
    state = task.state(physics)
    assert state.shape == (58,)
    np.testing.assert_allclose(state[42:45], task.prop_position(physics), atol=1e-6)
    np.testing.assert_array_equal(state[-3:], np.float32(target))
    np.testing.assert_array_equal(state[:42], task.robot.proprio(physics, "full"))
    relative = task.state(physics, "relative")
    np.testing.assert_array_equal(relative[:58], state)
    np.testing.assert_allclose(state[30:33] + relative[58:61], state[42:45], atol=1e-6)
    np.testing.assert_allclose(state[42:45] + relative[61:], state[55:58], atol=1e-6)


def test_success_and_rewards_depend_on_the_distances(episodes):
    task, draw = episodes.task, np.random.RandomState(0)
    physics = episodes.start(1)
    for distance in draw.uniform(0.0, 0.15, 200):
        direction = draw.normal(size=3)
        put_box(episodes, task.target + distance * direction / np.linalg.norm(direction))
        assert task.distance(physics) == pytest.approx(distance, abs=1e-9)
        assert task.success(physics) == (task.distance(physics) <= 0.01)
    for distance in draw.uniform(0.0, 0.15, 200):
        direction = draw.normal(size=3)
        hand = task.robot.tool_center_point(physics)
        put_box(episodes, hand + distance * direction / np.linalg.norm(direction))
        assert task.hand_distance(physics) == pytest.approx(distance, abs=1e-9)
        terms = task.reward_terms(physics)
        assert tuple(terms) == task.term_names
        assert terms["reaching"] == pytest.approx(rewards.reach(distance)["reaching"] / len(terms))
        gated = terms["pushing"] if episodes.name == "move_box" else terms["lifting"]
        assert (gated > 0) == (distance < 0.05)  # hand and box are in the air
        assert task.get_reward(physics) == sum(terms.values())
        assert 0 <= task.get_reward(physics) <= 1


@pytest.mark.parametrize("name", BOX_TASKS)
def test_staged_reward_pays_most_within_one_centimetre_of_the_target(name):
    task = make_task(name, reward="staged")
    physics = task.compile()
    task.start_episode(physics, np.random.RandomState(0))

    def terms(box):
        physics.data.qpos[-7:] = (*box, 1.0, 0.0, 0.0, 0.0)
        physics.forward()
        return task.reward_terms(physics)

    hand = task.robot.tool_center_point(physics)
    for offset, success in ((0.01, 1.0), (0.02, 0.1)):
        task.target = hand + np.array([0.0, 0.0, offset])
        paid = terms(hand)
        assert tuple(paid) == task.term_names
        assert task.term_names[-1] == "success"
        assert paid["success"] == pytest.approx(success / len(paid))
    assert terms(hand + np.array([0.051, 0.0, 0.0]))["success"] == 0.0


def test_reward_at_the_start_is_only_for_an_upright_hand(episodes):
    """The hand starts vertical: a return up to this reward does not show any learning."""
    terms = episodes.task.reward_terms(episodes.start(4))
    assert sum(terms.values()) == pytest.approx(
        0.25 if episodes.name == "lift_box" else 0, abs=0.01
    )


def test_a_box_at_rest_on_the_target_is_a_success():
    """The target of move_box is a position that a box on the floor can reach."""
    episodes = Episodes("move_box")
    physics = episodes.start(0)
    put_box(episodes, (0.0, -0.2, 0.03))
    physics.step(200)
    assert episodes.task.success(physics)


def test_the_mark_is_visible_around_the_box_and_has_no_contacts():
    episodes = Episodes("move_box")
    physics = episodes.start(0)
    mark = physics.model.name2id("mark", "geom")
    assert physics.model.geom_rgba[mark, 3] == 1.0
    counter = Segmentation(physics, 84)
    alone = counter.pixels(mark)
    put_box(episodes, (0.01, -0.2, 0.025))
    behind = counter.pixels(mark)
    assert alone > 100
    assert 0.25 * alone < behind < 0.75 * alone
    physics.step(100)
    assert all(mark not in (contact.geom1, contact.geom2) for contact in physics.data.contact)


def hidden_fractions(name, seeds, size):
    """Return the fraction of the box's pixels that the disc hides, for each start."""
    occluded, plain = Episodes(name, occluded=True), Episodes(name)
    count, count_plain = (Segmentation(e.physics, size) for e in (occluded, plain))
    shares = []
    for seed in seeds:
        occluded.start(seed)
        plain.physics.data.qpos[:] = occluded.physics.data.qpos
        plain.physics.forward()
        free = count_plain.pixels(box_geom(plain))
        assert free > 0
        shares.append(1.0 - count.pixels(box_geom(occluded)) / free)
    return np.array(shares)


@pytest.mark.parametrize("name", BOX_TASKS)
def test_the_disc_hides_half_of_the_box_in_half_of_the_starts(name):
    assert (hidden_fractions(name, range(60), 120) >= 0.5).mean() >= 0.45


@pytest.mark.long
@pytest.mark.parametrize("name", BOX_TASKS)
def test_the_disc_hides_half_of_the_box_in_half_of_a_thousand_starts(name):
    assert (hidden_fractions(name, range(1000), 240) >= 0.5).mean() >= 0.5


def test_make_task_finds_tasks_and_rejects_unsupported_options():
    assert {"reach_duplo", "move_box", "lift_box"} <= {*TASKS}
    with pytest.raises(MerlError, match="did you mean 'move_box'"):
        make_task("move_boxes")
    with pytest.raises(MerlError, match="reach_duplo has no occluded form: choose from move_box"):
        make_task("reach_duplo", occluded=True)
    with pytest.raises(MerlError, match="reach_duplo has no start 'around', only 'above'"):
        make_task("reach_duplo", starts=("around",))
    with pytest.raises(MerlError, match="occluded needs --start above"):
        make_task("lift_box", occluded=True, starts=("around",))


@pytest.mark.parametrize("name", BOX_TASKS)
def test_the_hand_can_start_around_the_box_without_contact(name):
    episodes, above = Episodes(name, starts=("around",)), Episodes(name)
    task, offsets, velocities = episodes.task, [], []
    for seed in range(50):
        physics = episodes.start(seed)
        prop = task.prop_position(physics)
        np.testing.assert_array_equal(prop, above.task.prop_position(above.start(seed)))
        offsets.append(task.robot.tool_center_point(physics) - prop)
        velocities.append(np.abs(physics.data.qvel).max())
        assert task.robot.tilt_cosine(physics) > 0.99
        robot = set(physics.bind(task.robot.arm.mjcf_model.find_all("geom")).element_id)
        for contact in physics.data.contact:
            pair = {contact.geom1, contact.geom2}
            assert contact.dist > 0 or not pair & robot or pair <= robot
    lower, upper = np.array(AROUND_BOX)
    assert (np.array(offsets) >= lower - 1e-3).all()
    assert (np.array(offsets) <= upper + 1e-3).all()
    assert (np.std(offsets, axis=0) > 0.003).all()
    assert max(velocities) < 1e-3


@pytest.mark.parametrize("name", BOX_TASKS)
def test_the_hand_can_start_holding_the_box(name):
    """All three fingers hold the box: it follows the motion of the arm."""
    episodes = Episodes(name, starts=("holding",))
    task, follows = episodes.task, []
    for seed in range(10):
        physics = episodes.start(seed)
        assert abs(task.prop_position(physics)[2] - BOX_HALF_SIZE) < 3e-3
        assert task.hand_distance(physics) < 0.03
        arm = make_expert(task, physics)
        goal = Pose(arm.hand.position + np.array([0.0, 0.0, 0.05]), arm.hand.rotation)
        for _ in range(50):
            physics.set_control(arm.towards(goal, SERVO_GAIN, GRIP))
            physics.step(task.physics_steps_per_control_step)
        follows.append(task.prop_position(physics)[2] - BOX_HALF_SIZE > 0.03)
    assert np.mean(follows) >= 0.8


@pytest.mark.parametrize("name", BOX_TASKS)
def test_the_hand_can_start_carrying_the_box(name):
    """The box is anywhere on the straight way, ends included, and the hand holds it."""
    episodes, above = Episodes(name, starts=("carrying",)), Episodes(name)
    task, shares, held = episodes.task, [], []
    for seed in range(30):
        before = above.task.prop_position(above.start(seed))
        physics = episodes.start(seed)
        way, moved = task.target - before, task.prop_position(physics) - before
        shares.append(moved @ way / (way @ way))
        np.testing.assert_allclose(moved, shares[-1] * way, atol=2e-3)
        assert task.hand_distance(physics) < 0.03
        assert task.robot.tilt_cosine(physics) > 0.99
        control = np.zeros(physics.model.nu)
        control[-3:] = GRIP
        for _ in range(25):
            physics.set_control(control)
            physics.step(task.physics_steps_per_control_step)
        held.append(np.linalg.norm(task.prop_position(physics) - before - moved) < 0.03)
    assert min(shares) > -0.01
    assert max(shares) < 1.01
    assert np.std(shares) == pytest.approx(12**-0.5, rel=0.3)
    assert np.mean(held) >= 0.6


def test_a_box_slides_on_the_floor_with_a_friction_of_one():
    """A box at 0.5 m/s stops after v^2 / (2 mu g)."""
    episodes, speed, friction = Episodes("move_box"), 0.5, 1.0
    physics = episodes.start(0)
    before = episodes.task.prop_position(physics)
    physics.data.qvel[-6] = speed
    physics.step(500)
    slid = np.linalg.norm(episodes.task.prop_position(physics) - before)
    assert slid == pytest.approx(speed**2 / (2 * friction * 9.81), rel=0.25)


def test_each_episode_draws_one_of_several_starts():
    episodes = Episodes("lift_box", starts=("above", "around"))
    near = [episodes.task.hand_distance(episodes.start(seed)) < 0.05 for seed in range(30)]
    assert 5 < sum(near) < 25
