"""How the arm can take hold of a box and bring it somewhere without touching anything else."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from merl.tasks.kinematics import Array, Kinematics, Path, Pose

OPEN = np.full(3, 0.45)
"""Angles of the fingers around a box, rad."""
CLOSING = tuple(np.full(3, angle) for angle in (0.6, 0.7, 0.8, 0.9, 1.0))
"""While and after they close, rad: their tips are lowest between 0.6 and 0.9."""
TILTS = tuple(np.radians([0, 20, 30, 40, 45, 50, 55, 60, 65, 70]))
"""Of the hand against straight down, rad: the larger, the further it gets under something."""
GRIPS = ((0.0, 0.0), (0.0, 0.006), (0.006, 0.006), (0.006, 0.0))
"""Where the fingers close: above the middle of the box, and back along the hand, m."""
FINGERS_MIDDLE = -0.011
"""Where a box lies between the fingers along the hand's y axis, m."""
STRAIGHT = 0.2
"""How far the hand goes at most straight to a box, and straight back with it, m."""
STRAIGHT_STEPS = 2
"""Of the approach at least, where there is room: `LINE_STEP` each."""
TOP = 0.36
"""Up to here the hand may rise on its way, m."""
UNREACHED = 10.0
"""What it costs that the goal seems out of reach, s."""
TURNS = tuple(np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180]))
"""About the vertical, by which the hand may turn while it carries, rad."""
OFF_CENTRE = 100.0
"""What a metre off the middle of the box costs, s/m: the grip is less sure."""
BRIDGES = 80
"""Number of direct connections, the fastest first, that are checked for collisions."""
DETOURS = 400
"""Number of connections over one random pose that are checked where no direct one is free."""
DETOUR_SPREAD = 0.5
"""Standard deviation of that pose around the direct connection, rad."""
TRIED = 2
"""At least this many grasps, the most promising first, are planned before the fastest is taken."""
FAST = 5.0
"""As long as the fastest plan takes longer, the other grasps are planned too: an episode has 10 s
and the box must be set down in it, s."""


def hand_rotation(azimuth: float, tilt: float, roll: float = 1.0) -> Array:
    """Of a hand whose fingers open horizontally, (3, 3).

    Args:
        azimuth: of where the hand points, about the vertical, rad.
        tilt: 0 points down, pi/2 horizontally.
        roll: 1 or -1: which side the single finger is on.
    """
    across, down = np.sin(tilt), np.cos(tilt)
    pointing = np.array([across * np.cos(azimuth), across * np.sin(azimuth), -down])
    opening = roll * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([opening, np.cross(pointing, opening), pointing], axis=1)


def azimuth_of(pose: Pose) -> float:
    """What `hand_rotation` was given, rad, for a roll of 1."""
    return float(np.arctan2(-pose.rotation[0, 0], pose.rotation[1, 0]))


def turned(rotation: Array, angle: float) -> Array:
    """A rotation (3, 3) turned further about the vertical, by rad."""
    sine, cosine = np.sin(angle), np.cos(angle)
    about: Array = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return about @ rotation


def find_approach(
    arm: Kinematics, q: Array, box: Pose, goal: Array, tilts: Sequence[float], upright: bool
) -> Path | None:
    """A fast one of the paths to a grasp from which the box can be brought to its goal.

    Args:
        arm: it sees the world with open fingers.
        q: where the arm is.
        box: where the box is.
        goal: where its middle is to be brought, (3,), m.
        tilts: that the hand may have, rad.
        upright: see `find_carry`.

    Returns:
        From `q` to where the fingers have only to close; None if there is none.
    """
    starts = _rises(arm, [q], None)
    found: list[tuple[float, Path]] = []
    for at in _reachable(arm, q, box, goal, tilts):
        ends = _ways_off(arm, at, None, STRAIGHT_STEPS)
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


def _reachable(
    arm: Kinematics, q: Array, box: Pose, goal: Array, tilts: Sequence[float]
) -> list[Array]:
    """Where the arm is around the box and touches nothing, the most promising first."""
    level = box.rotation[:, np.abs(box.rotation[2]).argmin()]  # normal to a face that stands
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
    """Whether the fingers can close around the box and touch nothing else."""
    held, free = arm.pose(q).relative(box), True
    for fingers in CLOSING:
        arm.bend(fingers)
        free = free and arm.is_free([q], held)
    arm.bend(OPEN)
    return free


def find_carry(arm: Kinematics, q: Array, held: Pose, goal: Array, upright: bool) -> Path | None:
    """The fastest of some free paths that bring a held box to its goal.

    Args:
        arm: it sees the world with the fingers around the box.
        q: where the arm is.
        held: the box's pose in the hand's frame.
        goal: where the middle of the box is to be brought, (3,), m.
        upright: the hand may straighten up, and the box then tilts; else the box stays level.

    Returns:
        From `q` on; None if there is none.
    """
    rotation = arm.pose(q).rotation
    rotations = [turned(rotation, turn) for turn in TURNS]
    if upright:
        azimuth = azimuth_of(arm.pose(q))
        rotations += [hand_rotation(azimuth + turn, 0.0) for turn in TURNS]
    found = [arm.solve(q, Pose(goal - r @ held.position, r)) for r in rotations]
    free = [end for end in found if end is not None and arm.is_free([end], held)]
    ends = [rise for end in free for rise in _rises(arm, [end], held)]
    starts = _ways_off(arm, q, held, 0)[1:]  # the box is lifted before it is carried
    return _connected(arm, starts, ends, held)


def _connected(
    arm: Kinematics, starts: list[Path], ends: list[Path], held: Pose | None = None
) -> Path | None:
    """Return the fastest free path along one of `starts`, over to one of `ends`, and back along it.

    It goes over straight or, where that is not free, by way of one other pose of the arm.
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
    """Join a path, poses between, and another path backwards; None unless all of it is free."""
    path = [*start, *middle, *end[::-1]]
    if not arm.is_free([start[-1], *middle, end[-1]], held, lifted=True):
        return None
    corners_rounded = list(arm.timed(path)[::3])
    return path if arm.is_free(corners_rounded, held) else None


def _ways_off(arm: Kinematics, q: Array, held: Pose | None, least: int) -> list[Path]:
    """Return paths that go straight back from where the hand points, then straight up.

    They go back by `least` steps or more, or as far as there is room.
    """
    line = arm.line(q, -STRAIGHT * arm.pose(q).rotation[:, 2], held)
    backs = [line[: i + 1] for i in range(min(least, len(line) - 1), len(line))]
    return [rise for back in backs for rise in _rises(arm, back, held)]


def _rises(arm: Kinematics, path: Path, held: Pose | None) -> list[Path]:
    """A path, and then straight up by each number of steps."""
    height = max(0.0, TOP - arm.pose(path[-1]).position[2])
    up = arm.line(path[-1], np.array([0.0, 0.0, height]), held)
    return [[*path, *up[1:i]] for i in range(1, len(up) + 1)]
