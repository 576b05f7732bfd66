"""Plan grasps of a box, and paths that carry it to a goal without collisions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from merl.tasks.kinematics import Array, Kinematics, Path, Pose

OPEN = np.full(3, 0.45)
"""Angles of the open fingers around a box, rad."""
CLOSING = tuple(np.full(3, angle) for angle in (0.6, 0.7, 0.8, 0.9, 1.0))
"""Angles of the fingers during and after closing, rad; the tips are lowest between 0.6 and 0.9."""
TILTS = tuple(np.radians([0, 20, 30, 40, 45, 50, 55, 60, 65, 70]))
"""Angles of the hand from straight down, rad. A larger tilt reaches further under an obstacle."""
GRIPS = ((0.0, 0.0), (0.0, 0.006), (0.006, 0.006), (0.006, 0.0))
"""Offsets of the grip from the centre of the box: upwards, and back along the hand, m."""
FINGERS_MIDDLE = -0.011
"""Position of the box between the fingers, along the hand's y axis, m."""
STRAIGHT = 0.2
"""Maximum length of the straight approach to a box, and of the straight retreat with it, m."""
STRAIGHT_STEPS = 2
"""Minimum number of straight steps in an approach, `LINE_STEP` each, if there is space."""
TOP = 0.36
"""Maximum height to which the hand rises on a path, m."""
UNREACHED = 10.0
"""Cost of a grasp from which the goal seems out of reach, s."""
TURNS = tuple(np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180]))
"""Angles by which the hand may turn about the vertical while it carries the box, rad."""
OFF_CENTRE = 100.0
"""Cost per metre between the grip and the centre of the box, s/m: such a grip is less secure."""
BRIDGES = 80
"""Maximum number of direct connections, fastest first, that are checked for collisions."""
DETOURS = 400
"""Number of connections over one random pose; they are checked if no direct one is free."""
DETOUR_SPREAD = 0.5
"""Standard deviation of the random pose around the direct connection, rad."""
TRIED = 2
"""Minimum number of grasps, lowest cost first, that are planned before the fastest is chosen."""
FAST = 5.0
"""While the fastest plan takes longer than this, s, further grasps are planned: the box must be set
down within an episode of 10 s."""


def hand_rotation(azimuth: float, tilt: float, roll: float = 1.0) -> Array:
    """Return the rotation of a hand whose fingers open horizontally, (3, 3).

    Args:
        azimuth: direction in which the hand points, about the vertical, rad.
        tilt: angle from straight down, rad: 0 points down, pi/2 points horizontally.
        roll: 1 or -1: the side of the single finger.
    """
    across, down = np.sin(tilt), np.cos(tilt)
    pointing = np.array([across * np.cos(azimuth), across * np.sin(azimuth), -down])
    opening = roll * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([opening, np.cross(pointing, opening), pointing], axis=1)


def azimuth_of(pose: Pose) -> float:
    """Return the azimuth of a `hand_rotation` with a roll of 1, rad."""
    return float(np.arctan2(-pose.rotation[0, 0], pose.rotation[1, 0]))


def turned(rotation: Array, angle: float) -> Array:
    """Return a rotation (3, 3) after a further turn about the vertical by `angle`, rad."""
    sine, cosine = np.sin(angle), np.cos(angle)
    about: Array = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return about @ rotation


def find_approach(
    arm: Kinematics, q: Array, box: Pose, goal: Array, tilts: Sequence[float], upright: bool
) -> Path | None:
    """Return a fast path to a grasp from which the box can be brought to its goal.

    Args:
        arm: the kinematic model, loaded with open fingers.
        q: current angles of the arm's joints.
        box: pose of the box.
        goal: target of the box's centre, (3,), m.
        tilts: allowed tilts of the hand, rad.
        upright: see `find_carry`.

    Returns:
        A path from `q` to a pose in which only the fingers have to close; None if none is found.
    """
    starts = _rises(arm, [q], None)
    found: list[tuple[float, Path]] = []
    for at in _reachable_grasps(arm, q, box, goal, tilts):
        ends = _retreats(arm, at, None, STRAIGHT_STEPS)
        approach = _connected(arm, starts, ends)
        if approach is None:
            continue
        carry = find_carry(arm, at, arm.pose(at).relative(box), goal, upright)
        if carry is not None:
            found.append((arm.seconds(approach) + arm.seconds(carry), approach))
        if len(found) >= TRIED and min(found, key=_seconds)[0] <= FAST:
            break
    return min(found, key=_seconds)[1] if found else None


def _seconds(plan: tuple[float, Path]) -> float:
    return plan[0]


def _reachable_grasps(
    arm: Kinematics, q: Array, box: Pose, goal: Array, tilts: Sequence[float]
) -> list[Array]:
    """Return joint angles of the arm at collision-free grasps of the box, lowest cost first."""
    level = box.rotation[:, np.abs(box.rotation[2]).argmin()]  # normal of an upright face
    yaw = np.arctan2(level[1], level[0])
    costs, found = [], []
    for quarter, tilt, roll in product(range(4), tilts, (1.0, -1.0)):
        rotation = hand_rotation(yaw + quarter * np.pi / 2, tilt, roll)
        for up, back in GRIPS:
            middle = rotation @ (0.0, FINGERS_MIDDLE, back)
            at = arm.solve(q, Pose(box.position - middle + (0.0, 0.0, up), rotation))
            if at is None:
                break
            if arm.is_free([at]) and _can_close(arm, at, box):
                there = arm.solve(at, Pose(goal, rotation))
                carry = UNREACHED if there is None else arm.seconds([at, there])
                costs.append(arm.seconds([q, at]) + carry + OFF_CENTRE * (up + back))
                found.append(at)
                break
    return [found[i] for i in np.argsort(costs, kind="stable")]


def _can_close(arm: Kinematics, q: Array, box: Pose) -> bool:
    """Return whether the fingers can close around the box without touching anything else."""
    held, free = arm.pose(q).relative(box), True
    for fingers in CLOSING:
        arm.bend(fingers)
        free = free and arm.is_free([q], held)
    arm.bend(OPEN)
    return free


def find_carry(arm: Kinematics, q: Array, held: Pose, goal: Array, upright: bool) -> Path | None:
    """Return the fastest of several free paths that bring a held box to its goal.

    Args:
        arm: the kinematic model, loaded with the fingers around the box.
        q: current angles of the arm's joints.
        held: pose of the box in the hand's frame.
        goal: target of the box's centre, (3,), m.
        upright: the hand may turn to point straight down, which tilts the box; otherwise the box
            stays level.

    Returns:
        A path that starts at `q`; None if none is found.
    """
    rotation = arm.pose(q).rotation
    rotations = [turned(rotation, turn) for turn in TURNS]
    if upright:
        azimuth = azimuth_of(arm.pose(q))
        rotations += [hand_rotation(azimuth + turn, 0.0) for turn in TURNS]
    found = [arm.solve(q, Pose(goal - r @ held.position, r)) for r in rotations]
    free = [end for end in found if end is not None and arm.is_free([end], held)]
    ends = [rise for end in free for rise in _rises(arm, [end], held)]
    starts = _retreats(arm, q, held, 0)[1:]  # the box is lifted before it is carried
    return _connected(arm, starts, ends, held)


def _connected(
    arm: Kinematics, starts: list[Path], ends: list[Path], held: Pose | None = None
) -> Path | None:
    """Return the fastest free path along one of `starts`, over to one of `ends`, and back along it.

    The connection is direct or, if no direct one is free, leads over one other pose of the arm.
    """
    if not starts or not ends:
        return None
    here, there = (np.array([path[-1] for path in paths]) for paths in (starts, ends))
    along = np.array([arm.seconds(path) for path in starts])[:, None]
    along = along + np.array([arm.seconds(path) for path in ends])  # (starts, ends)
    direct = along + arm.durations(here[:, None] - there)
    for index in np.argsort(direct, axis=None, kind="stable")[:BRIDGES]:
        path = _joined(arm, starts[index // len(ends)], [], ends[index % len(ends)], held)
        if path is not None:
            return path
    rng = np.random.default_rng(0)  # the same scene gives the same path
    start, end = rng.integers(len(starts), size=DETOURS), rng.integers(len(ends), size=DETOURS)
    by_way_of = here[start] + rng.random((DETOURS, 1)) * (there[end] - here[start])
    by_way_of = arm.within_limits(by_way_of + rng.normal(0.0, DETOUR_SPREAD, by_way_of.shape))
    costs = arm.durations(here[start] - by_way_of) + arm.durations(by_way_of - there[end])
    for i in np.argsort(costs + along[start, end], kind="stable"):
        path = _joined(arm, starts[start[i]], [by_way_of[i]], ends[end[i]], held)
        if path is not None:
            return path
    return None


def _joined(
    arm: Kinematics, start: Path, middle: Path, end: Path, held: Pose | None
) -> Path | None:
    """Join a path, poses between, and a reversed path; return None unless all of it is free."""
    path = [*start, *middle, *end[::-1]]
    if not arm.is_free([start[-1], *middle, end[-1]], held, lifted=True):
        return None
    corners_rounded = list(arm.timed(path)[::3])
    return path if arm.is_free(corners_rounded, held) else None


def _retreats(arm: Kinematics, q: Array, held: Pose | None, least: int) -> list[Path]:
    """Return paths that lead straight back along the hand's axis, then straight up.

    The straight part has `least` steps or more, or as many as there is space for.
    """
    line = arm.line(q, -STRAIGHT * arm.pose(q).rotation[:, 2], held)
    backs = [line[: i + 1] for i in range(min(least, len(line) - 1), len(line))]
    return [rise for back in backs for rise in _rises(arm, back, held)]


def _rises(arm: Kinematics, path: Path, held: Pose | None) -> list[Path]:
    """Return extensions of a path, straight up by every possible number of steps."""
    height = max(0.0, TOP - arm.pose(path[-1]).position[2])
    up = arm.line(path[-1], np.array([0.0, 0.0, height]), held)
    return [[*path, *up[1:i]] for i in range(1, len(up) + 1)]
