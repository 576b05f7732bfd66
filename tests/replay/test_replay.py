"""Replay against a brute-force model of its contents; its files, errors, resuming and growth."""

from __future__ import annotations

import ctypes
import errno
import json
import math
import mmap
import os
import resource
import tempfile
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers import wait_for
from merl.accelerate.device_replay import DeviceReplay
from merl.core import Batch, MerlError, Observation, Transition
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec, check_fits, stack_reader
from merl.replay.ring import EpisodeRing
from merl.replay.spec import KeySpec, span_name
from merl.replay.stack_reader import ReadAhead

IMAGES = {"front": (3, 4, 3), "wrist/left": (2, 2, 1)}
OBSERVATIONS = gymnasium.spaces.Dict(
    {key: gymnasium.spaces.Box(0, 255, shape, np.uint8) for key, shape in IMAGES.items()}
    | {"joints": gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float32)}
)
ACTIONS = gymnasium.spaces.Box(-1, 1, (2,), np.float32)


def config(**values: Any) -> ReplayConfig:
    return ReplayConfig(**{"capacity": 20, "batch_size": 1, "discount": 0.9} | values)


def spec_of(config: ReplayConfig, **values: Any) -> ReplaySpec:
    return ReplaySpec.of(config, OBSERVATIONS, ACTIONS, **values)


def make(directory: Path | None = None, **values: Any) -> ReplayBuffer:
    return ReplayBuffer(spec_of(config(**values)), directory)


def observe(episode: int, t: int) -> dict[str, np.ndarray]:
    """Return the observation at timestep t of an episode; timesteps and pixels differ."""
    seen: dict[str, np.ndarray] = {}
    for salt, (key, shape) in enumerate(IMAGES.items()):
        pixels = np.arange(np.prod(shape), dtype=np.int64).reshape(shape)
        seen[key] = ((episode * 37 + t * 101 + pixels * 7 + salt * 53) % 256).astype(np.uint8)
    seen["joints"] = np.arange(5, dtype=np.float32) + 10 * t + 1000 * episode
    return seen | {"not kept": np.zeros(3)}


def act(episode: int, t: int) -> np.ndarray:
    """Return the action of step t, which identifies the step."""
    return np.array([episode, t], np.float32)


def reward_of(episode: int, t: int) -> float:
    return float(np.float32(np.sin(1 + episode * 13.7 + t * 3.1)))


@dataclass
class Episode:
    length: int
    ending: str  # "end": a true end, "limit": truncated, "cut": not ended before the next


class Every:
    """Replacement of a random generator that draws each possible step once, in order."""

    def integers(self, low: int, high: int, size: int) -> np.ndarray:
        return np.arange(low, high)


@dataclass
class Account:
    """Simple model of the required behaviour of a replay: lists, loops, one row at a time."""

    config: ReplayConfig
    timesteps: list[tuple[int, int]] = field(
        default_factory=list
    )  # (episode, t) of all ever written
    ended: set[int] = field(default_factory=set)  # episodes that truly ended
    lost: int = 0  # number of oldest timesteps that are overwritten

    @property
    def slots(self) -> int:
        config = self.config
        least = config.frame_stack + 2
        if config.compress:
            least = 5 * (least + 1)
        return max(config.capacity + config.capacity // 200 + config.frame_stack, least)

    def record(self, episode: int, t: int) -> None:
        self.timesteps.append((episode, t))
        self.lost = max(self.lost, len(self.timesteps) - self.slots)

    def held(self) -> list[tuple[int, int]]:
        """Return the steps that must be sampled: the newest ones with a complete stack."""
        alive = set(self.timesteps[self.lost :])
        steps = [a for a, b in pairwise(self.timesteps) if b == (a[0], a[1] + 1)]
        whole = [(e, t) for e, t in steps if all(frame in alive for frame in self.stack(e, t))]
        return whole[-self.config.capacity :]

    def stack(self, episode: int, t: int) -> list[tuple[int, int]]:
        return [(episode, max(0, t - back)) for back in reversed(range(self.config.frame_stack))]

    def row(self, episode: int, t: int) -> tuple[float, float, int]:
        """Compute return, discount, and the timestep from which the return bootstraps."""
        last = max(s for e, s in self.timesteps if e == episode)
        total, weight = 0.0, 1.0
        for _ in range(self.config.n_step):
            total += weight * reward_of(episode, t)
            weight *= self.config.discount
            t += 1
            if t == last:
                return total, 0.0 if episode in self.ended else weight, t
        return total, weight, t


def write(
    replay: ReplayBuffer | EpisodeRing, account: Account, episode: int, t: int, plan: Episode
) -> None:
    """Write timestep t of an episode to the replay and to the account."""
    if t == 0:
        replay.begin(observe(episode, 0))
    else:
        last = t == plan.length and plan.ending != "cut"
        ends = last and plan.ending == "end"
        step = Transition(
            act(episode, t - 1), reward_of(episode, t - 1), 1.0 - ends, observe(episode, t), last
        )
        replay.add(step)
        if ends:
            account.ended.add(episode)
    account.record(episode, t)


def check(replay: ReplayBuffer, account: Account) -> None:
    """Compare all steps that the replay can sample with the account."""
    held = account.held()
    assert len(replay) == len(held)
    if held:
        check_rows(replay.sample(len(held), Every()), account, held)


def check_rows(batch: Batch, account: Account, steps: list[tuple[int, int]]) -> None:
    def stacked(key: str, episode: int, t: int) -> np.ndarray:
        return np.stack([observe(*timestep)[key] for timestep in account.stack(episode, t)])

    assert [tuple(row) for row in batch.action.tolist()] == steps
    rows = [account.row(*step) for step in steps]
    np.testing.assert_allclose(batch.reward, [row[0] for row in rows], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(batch.discount, [row[1] for row in rows], rtol=1e-6)
    ends = [(episode, end) for (episode, _), (_, _, end) in zip(steps, rows, strict=True)]
    for observation, timesteps in ((batch.observation, steps), (batch.next_observation, ends)):
        assert observation.keys() == set(OBSERVATIONS.spaces)
        for key in IMAGES:
            np.testing.assert_array_equal(observation[key], [stacked(key, *m) for m in timesteps])
        joints = [observe(*timestep)["joints"] for timestep in timesteps]
        np.testing.assert_array_equal(observation["joints"], joints)


configs = st.builds(
    config,
    capacity=st.integers(1, 12),
    n_step=st.integers(1, 5),
    frame_stack=st.integers(1, 4),
    discount=st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    compress=st.booleans(),
)
plans = st.lists(
    st.builds(Episode, st.integers(0, 9), st.sampled_from(["end", "limit", "cut"])),
    min_size=1,
    max_size=6,
)


def brute_force(settings: ReplayConfig, episodes: list[Episode]) -> None:
    replay = ReplayBuffer(spec_of(settings))
    account = Account(settings)
    for episode, plan in enumerate(episodes):
        for t in range(plan.length + 1):
            write(replay, account, episode, t, plan)
            check(replay, account)  # at every position of the next slot


@settings(max_examples=60, deadline=None)
@given(configs, plans)
def test_every_sample_equals_the_brute_force_model(config, episodes):
    brute_force(config, episodes)


@pytest.mark.long
@settings(max_examples=600, deadline=None)
@given(configs, plans)
def test_every_sample_equals_the_brute_force_model_long(config, episodes):
    brute_force(config, episodes)


@pytest.mark.parametrize(
    ("ending", "rewards", "discounts", "ends"),
    [
        # rewards 1, 2, 4, 8; gamma 1/2; n = 3
        ("end", [1 + 1 + 1, 2 + 2 + 2, 4 + 4, 8], [1 / 8, 0, 0, 0], [3, 4, 4, 4]),
        ("limit", [3, 6, 8, 8], [1 / 8, 1 / 8, 1 / 4, 1 / 2], [3, 4, 4, 4]),
        ("cut", [3, 6, 8, 8], [1 / 8, 1 / 8, 1 / 4, 1 / 2], [3, 4, 4, 4]),
        ("in progress", [3, 6, 8, 8], [1 / 8, 1 / 8, 1 / 4, 1 / 2], [3, 4, 4, 4]),
    ],
)
def test_returns_computed_by_hand(ending, rewards, discounts, ends):
    replay = make(discount=0.5)
    replay.begin(observe(0, 0))
    for t, reward in enumerate([1, 2, 4, 8]):
        last = t == 3 and ending in ("end", "limit")
        discount = 0.0 if last and ending == "end" else 1.0
        replay.add(Transition(act(0, t), reward, discount, observe(0, t + 1), last))
    if ending != "in progress":
        replay.begin(observe(1, 0))
        replay.add(Transition(act(1, 0), 1000.0, 1.0, observe(1, 1), last=False))
    batch = replay.sample(4, Every())
    assert batch.reward[:4].tolist() == rewards
    assert batch.discount[:4].tolist() == discounts
    assert batch.next_observation["joints"][:4, 0].tolist() == [10.0 * t for t in ends]


def test_batch_has_the_documented_types_and_shapes():
    replay, account = make(), Account(config())
    for t in range(11):
        write(replay, account, 0, t, Episode(10, "end"))
    batch = replay.sample(7, np.random.default_rng(0))
    for observation in (batch.observation, batch.next_observation):
        assert observation["front"].shape == (7, 3, 3, 4, 3)
        assert observation["wrist/left"].shape == (7, 3, 2, 2, 1)
        assert observation["front"].dtype == torch.uint8
        assert observation["joints"].shape == (7, 5)
        assert observation["joints"].dtype == torch.float32
        assert all(tensor.is_contiguous() for tensor in observation.values())
    assert batch.action.shape == (7, 2)
    assert batch.reward.shape == batch.discount.shape == (7,)
    assert {batch.action.dtype, batch.reward.dtype, batch.discount.dtype} == {torch.float32}


def test_later_writes_do_not_change_a_batch():
    replay, account = make(capacity=4), Account(config(capacity=4))
    for t in range(5):
        write(replay, account, 0, t, Episode(50, "end"))
    batch = replay.sample(4, Every())
    kept = batch.observation["front"].clone()
    for t in range(5, 30):
        write(replay, account, 0, t, Episode(50, "end"))
    replay.sample(4, Every())
    assert torch.equal(batch.observation["front"], kept)


def test_same_generator_and_contents_give_the_same_batch():
    replay, account = make(), Account(config())
    for t in range(15):
        write(replay, account, 0, t, Episode(50, "end"))
    one, two, other = (replay.sample(64, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert torch.equal(one.action, two.action)
    assert torch.equal(one.next_observation["front"], two.next_observation["front"])
    assert not torch.equal(one.action, other.action)


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("n_step", [3, 6])
def test_read_ahead_requests_exactly_the_batch(tmp_path, monkeypatch, compress, n_step):
    """With n_step 6 the images between o_t and o_{t+n} are not requested."""
    replay = make(tmp_path / "ring", capacity=30, compress=compress, n_step=n_step)
    account = Account(replay.spec.config)
    for episode in range(9):  # the ring wraps
        for t in range(8):
            write(replay, account, episode, t, Episode(7, "limit"))
    requested, indices, pick = [], [], replay._sampler.pick
    monkeypatch.setattr(replay._ahead, "request", lambda _, *range: requested.append(range))
    replay.sample(1, Every())
    assert not requested  # all images are in memory
    monkeypatch.setattr(ReadAhead, "is_wanted", True)
    replay._sampler.pick = lambda *a, **k: (indices.append(pick(*a, **k)), indices[0])[1]
    replay.sample(1, Every())
    now, then = indices[0].now, indices[0].then
    parts = [torch.cat([now, then], dim=1)] if n_step == 3 else [now, then]
    wanted = [(part.numpy(), *image) for part in parts for image in IMAGES.items()]
    for (slots, key, shape), (begin, end) in zip(wanted, requested, strict=True):
        size = math.prod(shape)
        at, count = slots * size, size
        if compress:
            at, count = np.moveaxis(replay.arrays[span_name(key)][slots], -1, 0)
        contiguous = end > begin
        assert contiguous.mean() > 0.5
        assert compress or n_step == 6 or not contiguous.all()
        assert (begin[:, None] <= at)[contiguous].all()
        assert (at + count <= end[:, None])[contiguous].all()
        assert (end - begin)[contiguous].max() <= slots.shape[1] * (size + 64 * compress)


def test_read_ahead_is_active_for_some_batches_after_page_faults(monkeypatch):
    faults = 0
    monkeypatch.setattr(stack_reader, "_major_page_faults", lambda: faults)
    ahead = ReadAhead()

    def batch(pages):
        nonlocal faults
        wanted = ahead.is_wanted
        ahead.begin()
        faults += pages
        ahead.end()
        return wanted

    assert [batch(pages) for pages in (0, 8, 9)] == [False] * 3
    assert [batch(0) for _ in range(202)] == [True] * 200 + [False] * 2
    batch(300)
    assert [batch(9) for _ in range(500)] == [True] * 500


def test_read_ahead_reads_the_requested_pages_from_disk(tmp_path):
    pages = 300
    with (tmp_path / "frames").open("w+b") as file:
        file.write(bytes(pages * mmap.PAGESIZE))
        file.flush()
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        with mmap.mmap(file.fileno(), 0) as mapped:
            begin = np.array([5000, 100, 100 * mmap.PAGESIZE + 7, 290 * mmap.PAGESIZE])
            end = np.array([9000, 50, 101 * mmap.PAGESIZE, pages * mmap.PAGESIZE])
            ReadAhead.request(mapped, begin, end)
            wanted = {5000 // mmap.PAGESIZE, 9000 // mmap.PAGESIZE, 100, *range(290, pages)}
            wait_for(lambda: wanted <= in_memory(mapped))


def in_memory(mapped: mmap.mmap) -> set[int]:
    """Return the pages of a file that are in memory."""
    held = np.frombuffer(mapped, np.uint8)
    flags = np.zeros(-(-len(held) // mmap.PAGESIZE), np.uint8)
    place, size = ctypes.c_void_p(held.ctypes.data), ctypes.c_size_t(len(held))
    assert ctypes.CDLL(None).mincore(place, size, ctypes.c_void_p(flags.ctypes.data)) == 0
    return set(np.flatnonzero(flags & 1).tolist())


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("count", [1, 3])
def test_frame_transforms_are_applied_to_each_sample(compress, count):
    """A transform receives the sample's number in the batch, its stack, and its output array."""
    settings = config(capacity=90, compress=compress)
    rings = ReplayBuffer(spec_of(settings, rings=count))
    for number, ring in enumerate(rings.rings):
        account = Account(settings)
        for episode in range(4):
            for t in range(9):
                write(ring, account, 10 * number + episode, t, Episode(8, "limit"))
    plain = rings.sample(50, np.random.default_rng(3))
    samples = []

    def inverted(sample, frames, out):
        samples.append(sample)
        out[:] = 255 - frames

    batch = rings.sample(
        50, np.random.default_rng(3), {"front": inverted}, {"wrist/left": inverted}
    )
    assert sorted(samples) == sorted([*range(50), *range(50)])
    assert torch.equal(batch.observation["front"], 255 - plain.observation["front"])
    assert torch.equal(batch.observation["wrist/left"], plain.observation["wrist/left"])
    assert torch.equal(batch.next_observation["front"], plain.next_observation["front"])
    expected = 255 - plain.next_observation["wrist/left"]
    assert torch.equal(batch.next_observation["wrist/left"], expected)
    assert torch.equal(batch.reward, plain.reward)


def test_every_step_is_drawn_equally_often():
    replay, account = make(), Account(config())
    lengths = [9, 1, 1, 12, 0, 2, 5]
    for episode, length in enumerate(lengths):
        for t in range(length + 1):
            write(replay, account, episode, t, Episode(length, "end"))
    held = account.held()
    assert 0 < len(held) < sum(lengths)  # the ring has wrapped
    draws = 2000 * len(held)
    actions = replay.sample(draws, np.random.default_rng(1)).action.tolist()
    counts = dict.fromkeys(held, 0)
    for row in actions:
        counts[tuple(row)] += 1
    chi_square = sum((count - 2000) ** 2 / 2000 for count in counts.values())
    assert chi_square < 2.5 * len(held)  # the mean is len(held) - 1; the bound is above 99.99 %


def test_replay_holds_exactly_its_capacity():
    settings = config(capacity=1000)
    replay, account = ReplayBuffer(spec_of(settings)), Account(settings)
    for episode in range(6):
        for t in range(251):
            write(replay, account, episode, t, Episode(250, "limit"))
            assert len(replay) == min(episode * 250 + t, 1000)
    check(replay, account)


# Restoring a state, and opening again


class Run:
    """A replay in a directory and its account, which are written together."""

    def __init__(self, directory: Path, **values: Any) -> None:
        self.directory, self.values = directory, values
        self.replay = make(directory, **values)
        self.account = Account(config(**values))
        self.episode = -1

    def play(self, *lengths: int, ending: str = "end") -> None:
        for length in lengths:
            self.episode += 1
            for t in range(length + 1):
                write(self.replay, self.account, self.episode, t, Episode(length, ending))

    def restore(self, state: dict[str, Any], timesteps: int) -> None:
        del self.account.timesteps[timesteps:]
        self.replay = make(self.directory, **self.values)
        self.replay.load_state_dict(state)


def test_reopened_replay_holds_all_data(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(5, 4, 6)
    run.play(3, ending="cut")
    run.replay = make(run.directory)
    check(run.replay, run.account)
    with pytest.raises(ValueError, match="no episode is in progress"):
        run.replay.add(Transition(act(3, 3), 0.0, 1.0, observe(3, 4), last=False))
    run.play(7)
    check(run.replay, run.account)


def test_reopened_replay_holds_all_data_after_wrapping(tmp_path):
    run = Run(tmp_path / "replay")
    for length in range(9):
        run.play(length)
        run.replay = make(run.directory)
        check(run.replay, run.account)


def test_restored_replay_equals_an_uninterrupted_one(tmp_path):
    plain, broken = Run(tmp_path / "plain"), Run(tmp_path / "broken")
    for run in (plain, broken):
        run.play(5, 4, 6, 8)
    # Write a few more steps; then the process dies.
    state, timesteps = (
        json.loads(json.dumps(broken.replay.state_dict())),
        len(broken.account.timesteps),
    )
    episode = broken.episode
    broken.play(1)
    broken.restore(state, timesteps)
    broken.episode = episode
    assert broken.replay.state_dict() == plain.replay.state_dict()
    for run in (plain, broken):
        run.play(6, 2)
        check(run.replay, run.account)
    assert broken.replay.state_dict() == plain.replay.state_dict()
    one, two = (run.replay.sample(50, np.random.default_rng(2)) for run in (plain, broken))
    assert torch.equal(one.action, two.action)
    assert torch.equal(one.observation["front"], two.observation["front"])


def test_restored_episode_in_progress_continues(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(5)
    run.play(3, ending="cut")
    run.replay.flush()
    run.restore(run.replay.state_dict(), len(run.account.timesteps))
    write(run.replay, run.account, 1, 4, Episode(4, "end"))
    check(run.replay, run.account)


def restore_anywhere(settings: ReplayConfig, episodes: list[Episode], data: st.DataObject) -> None:
    """Save at some step, write, restore, write again: the contents are always correct."""
    replay, account = ReplayBuffer(spec_of(settings)), Account(settings)
    state, saved = replay.state_dict(), 0
    for episode, plan in enumerate(episodes):
        for t in range(plan.length + 1):
            write(replay, account, episode, t, plan)
        move = data.draw(st.sampled_from(["continue", "save", "restore"]))
        if move == "save":
            state, saved = replay.state_dict(), len(account.timesteps)
        elif move == "restore" and saved > account.lost:
            replay.load_state_dict(state)
            del account.timesteps[saved:]
        check(replay, account)


@settings(max_examples=60, deadline=None)
@given(configs, plans, st.data())
def test_restoring_at_any_time(config, episodes, data):
    restore_anywhere(config, episodes, data)


@pytest.mark.long
@settings(max_examples=600, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(configs, plans, st.data())
def test_restoring_at_any_time_long(config, episodes, data):
    restore_anywhere(config, episodes, data)


def restore_exactly(settings: ReplayConfig, episodes: list[Episode], data: st.DataObject) -> None:
    """Save, write, die at any time, restore: the replay holds the same steps as at the save."""
    with tempfile.TemporaryDirectory() as folder:
        replay = ReplayBuffer(spec_of(settings), Path(folder))
        account = Account(settings)
        state, saved, lost = replay.state_dict(), 0, 0
        for episode, plan in enumerate(episodes):
            for t in range(plan.length + 1):
                write(replay, account, episode, t, plan)
            move = data.draw(st.sampled_from(["continue", "save", "save and die", "die"]))
            if move.startswith("save"):
                replay.flush()
                state, saved, lost = replay.state_dict(), len(account.timesteps), account.lost
            if move == "save":
                replay.confirm_checkpoint()
            elif move.endswith("die"):
                replay = ReplayBuffer(spec_of(settings), Path(folder))
                replay.load_state_dict(state)
                del account.timesteps[saved:]
                account.lost = lost
            check(replay, account)


@settings(max_examples=40, deadline=None)
@given(configs, plans, st.data())
def test_restoring_after_a_crash_is_exact(config, episodes, data):
    restore_exactly(config, episodes, data)


@pytest.mark.long
@settings(max_examples=600, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(configs, plans, st.data())
def test_restoring_after_a_crash_is_exact_long(config, episodes, data):
    restore_exactly(config, episodes, data)


def test_full_disk_stops_the_journal_but_not_the_replay(tmp_path, caplog):
    class Full:
        def __init__(self, file):
            self.file = file

        def __getattr__(self, name):
            return getattr(self.file, name)

        def write(self, data):
            return self.file.write(data[:7])

    run = Run(tmp_path / "replay")
    run.play(9, 9)
    run.replay.flush()
    state, timesteps = run.replay.state_dict(), len(run.account.timesteps)
    run.replay.confirm_checkpoint()
    run.replay._journal._file = Full(run.replay._journal._file)
    run.play(9, 2)
    assert caplog.text.count("journal: No space left on device; until") == 1
    run.restore(state, timesteps)  # only steps that the ring still holds
    check(run.replay, run.account)
    assert 0 < len(run.replay) < 18


def test_steps_after_a_restored_state_are_discarded(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(4)
    state, timesteps = run.replay.state_dict(), len(run.account.timesteps)
    run.play(9)
    run.restore(state, timesteps)
    run.play(2, ending="cut")  # ends among timesteps that were written before
    run.replay = make(run.directory)
    check(run.replay, run.account)


def test_half_written_timestep_is_ignored(tmp_path):
    class Dies:
        def __setitem__(self, slot: int, value: float) -> None:
            raise KeyboardInterrupt

    run = Run(tmp_path / "replay")
    run.play(30, ending="cut")  # so that the next timestep overwrites an older one
    run.replay.rings[0]._data["reward"] = Dies()
    with pytest.raises(KeyboardInterrupt):
        run.replay.add(Transition(act(0, 30), 0.0, 1.0, observe(0, 31), last=False))
    run.account.lost += 1
    run.replay = make(run.directory)
    check(run.replay, run.account)


def test_state_of_another_replay_is_rejected(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(5)
    state = run.replay.state_dict()
    with pytest.raises(MerlError, match="does not hold timestep 6"):
        make().load_state_dict(state)
    check(run.replay, run.account)  # nothing has changed


def test_overwritten_state_without_journal_keeps_the_newer_steps(tmp_path, monkeypatch, caplog):
    """This happens if the disk was full from the last checkpoint on."""
    run = Run(tmp_path / "replay")
    run.play(5)
    state = run.replay.state_dict()
    run.replay.confirm_checkpoint()
    monkeypatch.setattr("merl.replay.journal.Journal.keep", lambda *_, **__: None)
    run.play(20, 20)
    for ring in (run.replay, make(run.directory)):
        ring.load_state_dict(state)
        assert "has overwritten timesteps of the checkpoint" in caplog.text
        check(ring, run.account)
        caplog.clear()


def test_ring_grows_if_opened_with_a_larger_capacity(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(5, 4, 6)
    run.values["capacity"] = 50
    run.account.config = config(capacity=50)
    state = run.replay.state_dict()
    run.replay = make(run.directory, capacity=50)
    run.replay.load_state_dict(state)
    run.play(9, 9, 9, 9, 9)
    check(run.replay, run.account)


def lengthen(run: Run, capacity: int) -> None:
    """Open and restore the replay of a run with a larger capacity."""
    held, state = run.account.held(), run.replay.state_dict()
    run.values["capacity"] = capacity
    run.account.config = config(**run.values)
    run.replay = make(run.directory, **run.values)
    run.replay.load_state_dict(state)
    assert run.replay.slots == run.account.slots
    assert run.account.held()[-len(held) :] == held


@pytest.mark.parametrize("capacity", [28, 29, 60])
@pytest.mark.parametrize("compress", [False, True])
def test_wrapped_ring_grows(tmp_path, capacity, compress):
    for more in range(0, 25, 4):  # at several positions of the next slot
        run = Run(tmp_path / str(more), compress=compress)
        run.play(9, 9, 9, 0)
        run.play(more)
        lengthen(run, capacity)
        check(run.replay, run.account)
        for length in (0, 7, 9, 2, 9, 9):
            run.play(length)
            check(run.replay, run.account)
        run.replay = make(run.directory, **run.values)
        check(run.replay, run.account)
        lengthen(run, 3 * capacity)
        run.play(*[8] * 9)
        check(run.replay, run.account)


@pytest.mark.parametrize("compress", [False, True])
def test_grown_ring_restores_its_last_checkpoint(tmp_path, compress):
    for more in (0, 2, 5, 9):
        run = Run(tmp_path / str(more), compress=compress)
        run.play(9, 9, 9, 5)
        run.replay.flush()
        state, timesteps, lost = (
            run.replay.state_dict(),
            len(run.account.timesteps),
            run.account.lost,
        )
        run.replay.confirm_checkpoint()
        run.play(*[2] * more)  # overwrites older timesteps; then the process dies
        run.values["capacity"] = 50
        run.account.config = config(**run.values)
        run.restore(state, timesteps)
        run.account.lost = lost
        check(run.replay, run.account)
        run.play(*[9] * 8)
        check(run.replay, run.account)


@pytest.mark.parametrize("killed", [False, True])
@pytest.mark.parametrize("function", ["posix_fallocate", "fsync", "rename"])
def test_failed_growth_keeps_the_old_contents(tmp_path, monkeypatch, function, killed):
    """Growth stops at several points, by an exception or by a kill without any cleanup."""
    run = Run(tmp_path)
    run.play(9, 9, 4)
    state = run.replay.state_dict()
    larger = make(tmp_path, capacity=70)

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, function, stop)
    if killed:
        monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)
    with pytest.raises(KeyboardInterrupt):
        larger.load_state_dict(state)
    monkeypatch.undo()
    assert (tmp_path / "part").exists() == killed
    run.replay = make(tmp_path)
    assert not (tmp_path / "part").exists()
    check(run.replay, run.account)
    lengthen(run, 70)
    check(run.replay, run.account)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["73"]


def test_smaller_capacity_samples_only_the_newest_steps(tmp_path):
    run = Run(tmp_path / "replay")
    run.play(5, 4, 6)
    replay = make(run.directory, capacity=7)
    assert len(replay) == 7
    steps = run.account.held()[-7:]
    check_rows(replay.sample(7, Every()), run.account, steps)
    run.replay = make(run.directory)
    check(run.replay, run.account)  # no data is lost


# Disk and memory


def files(directory: Path) -> list[Path]:
    return sorted(directory.rglob("*.bin"))


def test_step_takes_at_most_21_6_kilobytes(tmp_path):
    observations = gymnasium.spaces.Dict(
        {
            "image": gymnasium.spaces.Box(0, 255, (84, 84, 3), np.uint8),
            "proprio": gymnasium.spaces.Box(-np.inf, np.inf, (24,), np.float32),
        }
    )
    actions = gymnasium.spaces.Box(-1, 1, (9,), np.float32)
    settings = ReplayConfig(capacity=1000)
    spec = ReplaySpec.of(settings, observations, actions)
    replay = ReplayBuffer(spec, tmp_path)
    seen = observations.sample()
    for t in range(1000):
        if t % 250 == 0:
            replay.begin(seen)
        replay.add(Transition(actions.sample(), 0.0, 1.0, seen, last=t % 250 == 249))
    assert len(replay) == 1000
    on_disk = sum(file.stat().st_size for file in files(tmp_path))
    assert on_disk == spec.bytes
    in_memory = replay.rings[0].sources.nbytes
    million = replace(spec, capacity=1_000_000).bytes + 1000 * in_memory
    assert million <= 21_600 * 1_000_000


def test_files_have_the_documented_layout(tmp_path):
    run = Run(tmp_path)
    run.play(3)
    header = json.loads((tmp_path / "23/replay.json").read_text())
    assert header["rings"] == 1
    assert header["fields"]["observation.wrist%2Fleft"] == {"dtype": "|u1", "shape": [2, 2, 1]}
    assert {file.stem for file in files(tmp_path)} == set(header["fields"])
    frames = np.fromfile(tmp_path / "23/observation.front.bin", np.uint8).reshape(23, 3, 4, 3)
    for t in range(4):
        np.testing.assert_array_equal(frames[t], observe(0, t)["front"])


def assert_reserved(directory: Path) -> None:
    for file in files(directory):
        status = file.stat()
        assert status.st_blocks * 512 >= status.st_size > 0, file


def test_disk_space_is_reserved_before_use(tmp_path):
    make(tmp_path / "replay", capacity=5000)
    assert_reserved(tmp_path / "replay")


def test_disk_space_is_reserved_with_zeros_without_fallocate(tmp_path, monkeypatch):
    def refuse(*_: int) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    run = Run(tmp_path / "replay", capacity=50_000)
    assert_reserved(run.directory)
    run.play(5)
    check(run.replay, run.account)


def test_full_disk_leaves_no_files(tmp_path, monkeypatch):
    reserve, calls = os.posix_fallocate, []

    def full(file: int, start: int, size: int) -> None:
        calls.append(file)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        reserve(file, start, size)

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(MerlError, match=r"^cannot store a replay in .*: No space left on device$"):
        make(tmp_path / "run" / "replay")
    assert list(tmp_path.iterdir()) == []


def test_file_size_limit_leaves_no_files(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(MerlError, match="File too large"):
            make(tmp_path / "replay", capacity=5000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_growing_on_a_full_disk_changes_nothing(tmp_path, monkeypatch):
    run = Run(tmp_path)
    run.play(5, 4)
    state = run.replay.state_dict()
    before = {file: file.read_bytes() for file in tmp_path.rglob("*.*")}
    reserve = os.posix_fallocate

    def full(file: int, start: int, size: int) -> None:
        reserve(file, start, size)
        if size == 505 * 8:  # the last field, timestep
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(MerlError, match="No space left"):
        make(tmp_path, capacity=500).load_state_dict(state)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*.*")} == before
    run.replay = make(tmp_path)
    check(run.replay, run.account)


def test_incomplete_files_are_replaced(tmp_path):
    Run(tmp_path).play(5)
    (tmp_path / "23").rename(tmp_path / "part")
    run = Run(tmp_path)
    assert not (tmp_path / "part").exists()
    assert len(run.replay) == 0
    run.play(5)
    check(run.replay, run.account)


@pytest.mark.parametrize(
    ("function", "message"), [("available_memory", "of memory"), ("free_disk", "of disk")]
)
def test_error_names_the_largest_capacity_that_fits(tmp_path, monkeypatch, function, message):
    spec = spec_of(ReplayConfig())
    room = 30_000_000
    monkeypatch.setattr(f"merl.replay.capacity.{function}", lambda *_: room)
    directory = tmp_path / "run" / "replay"
    with pytest.raises(MerlError, match=message) as caught:
        ReplayBuffer(spec, directory)
    assert "1,000,000 steps" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
    words = str(caught.value).split()
    largest = int(words[words.index("--replay.capacity") + 1])
    assert replace(spec, capacity=largest).bytes <= room
    assert replace(spec, capacity=largest + 1).bytes > room
    check_fits(replace(spec, capacity=largest), directory)


@pytest.mark.parametrize("count", [1, 3, 7])
@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("capacity", [20, 100])
def test_several_rings_take_the_computed_bytes(tmp_path, count, compress, capacity):
    settings = config(capacity=capacity, batch_size=20, compress=compress)
    spec = spec_of(settings, rings=count)
    ReplayBuffer(spec, tmp_path)
    assert sum(file.stat().st_size for file in files(tmp_path)) == spec.bytes


def test_rings_that_do_not_fit_together_are_rejected(tmp_path, monkeypatch):
    spec = spec_of(config(capacity=100), rings=2)
    monkeypatch.setattr("merl.replay.capacity.available_memory", lambda: spec.bytes - 1)
    with pytest.raises(MerlError, match=r"100 steps .* --replay\.capacity"):
        ReplayBuffer(spec, tmp_path / "ring")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("merl.replay.capacity.available_memory", lambda: spec.bytes)
    ReplayBuffer(spec, tmp_path / "ring")


def test_error_suggests_compression_if_it_fits(monkeypatch):
    camera = gymnasium.spaces.Box(0, 255, (84, 84, 3), np.uint8)
    spaces = gymnasium.spaces.Dict({"camera": camera})
    raw, compressed = (
        ReplaySpec.of(ReplayConfig(compress=compress), spaces, ACTIONS)
        for compress in (False, True)
    )
    monkeypatch.setattr("merl.replay.capacity.available_memory", lambda: 8_000_000_000)
    with pytest.raises(MerlError) as caught:
        check_fits(raw)
    words = str(caught.value).split()
    assert words[words.index("--replay.compress") + 4] == f"{compressed.bytes / 1e9:.3g}"
    assert "--replay.capacity" in words
    check_fits(compressed)
    monkeypatch.setattr("merl.replay.capacity.available_memory", lambda: 5_000_000_000)
    with pytest.raises(MerlError, match=r"available: --replay\.capacity"):
        check_fits(raw)


def test_disk_space_is_ignored_without_a_directory(monkeypatch):
    monkeypatch.setattr("merl.replay.capacity.free_disk", lambda *_: 0)
    make()
    monkeypatch.setattr("merl.replay.capacity.available_memory", lambda: 10)
    with pytest.raises(MerlError, match="free some"):
        make()


def test_existing_replay_opens_on_a_disk_that_it_fills(tmp_path, monkeypatch):
    make(tmp_path)
    monkeypatch.setattr("merl.replay.capacity.free_disk", lambda *_: 0)
    make(tmp_path)
    with pytest.raises(MerlError, match="of disk"):
        make(tmp_path, capacity=25)


# Rejected input


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("capacity", 0),
        ("batch_size", 0),
        ("n_step", 0),
        ("frame_stack", -1),
        ("discount", 1.01),
        ("discount", float("nan")),
    ],
)
def test_error_names_field_and_value_out_of_range(name, value):
    flag = name.replace("_", "-")
    with pytest.raises(MerlError, match=rf"replay\.{flag} .* {value}"):
        ReplayConfig(**{name: value})


def test_batch_larger_than_the_replay_is_rejected():
    with pytest.raises(MerlError, match=r"batch-size 256 .* of 100 steps"):
        ReplayConfig(capacity=100)


@pytest.mark.parametrize(
    "space",
    [
        gymnasium.spaces.Discrete(3),
        gymnasium.spaces.Box(0, 255, (4, 4), np.uint8),
        gymnasium.spaces.Box(0, 1, (4, 4, 3), np.float32),
        gymnasium.spaces.Box(0, 9, (4,), np.int64),
        gymnasium.spaces.Box(0, 9, (0,), np.float32),
    ],
)
def test_space_that_is_neither_image_nor_vector_is_rejected(space):
    with pytest.raises(MerlError, match="observation 'depth'"):
        ReplaySpec.of(config(), gymnasium.spaces.Dict({"depth": space}), ACTIONS)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("front", np.zeros((4, 3, 3), np.uint8)),
        ("front", np.zeros((3, 4, 3), np.float32)),
        ("front", np.zeros((3, 4, 3), np.uint16)),
        ("joints", np.zeros(4, np.float32)),
        ("joints", np.zeros((1, 5), np.float32)),
        ("joints", np.zeros(5, np.int64)),
        ("joints", None),
    ],
)
def test_observation_that_does_not_fit_its_space_changes_nothing(key, value):
    replay, account = make(), Account(config())
    for t in range(6):
        write(replay, account, 0, t, Episode(50, "end"))
    wrong: Observation = observe(0, 6) | {key: value}
    with pytest.raises(MerlError, match=key):
        replay.add(Transition(act(0, 5), 0.0, 1.0, wrong, last=False))
    with pytest.raises(MerlError, match=key):
        replay.begin(wrong)
    check(replay, account)
    write(replay, account, 0, 6, Episode(50, "end"))  # the episode is still in progress
    check(replay, account)


def test_vectors_of_another_float_type_are_accepted():
    replay = make()
    replay.begin(observe(0, 0) | {"joints": np.arange(5, dtype=np.float64)})
    replay.add(Transition(np.zeros(2, np.float64), 0, 1, observe(0, 1), last=False))
    assert replay.sample(1, Every()).observation["joints"].tolist() == [[0, 1, 2, 3, 4]]


def test_action_of_another_shape_is_rejected():
    replay = make()
    replay.begin(observe(0, 0))
    with pytest.raises(MerlError, match="action"):
        replay.add(Transition(np.zeros(3, np.float32), 0.0, 1.0, observe(0, 1), last=False))


def test_calls_out_of_order_are_rejected():
    replay = make()
    step = Transition(act(0, 0), 0.0, 1.0, observe(0, 1), last=True)
    with pytest.raises(ValueError, match="empty"):
        replay.sample(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="begin"):
        replay.add(step)
    replay.begin(observe(0, 0))
    with pytest.raises(ValueError, match="empty"):
        replay.sample(1, np.random.default_rng(0))
    replay.add(step)
    with pytest.raises(ValueError, match="begin"):
        replay.add(step)


@pytest.mark.parametrize(("discount", "last"), [(0.0, False), (0.99, False), (0.99, True)])
def test_invalid_discount_is_rejected(discount, last):
    replay = make()
    replay.begin(observe(0, 0))
    with pytest.raises(ValueError, match="discount"):
        replay.add(Transition(act(0, 0), 0.0, discount, observe(0, 1), last))


def test_directory_with_another_replay_is_rejected(tmp_path):
    make(tmp_path)
    other = gymnasium.spaces.Dict({"joints": OBSERVATIONS["joints"]})
    with pytest.raises(MerlError, match="other observations"):
        ReplayBuffer(ReplaySpec.of(config(), other, ACTIONS), tmp_path)


def test_damaged_directory_is_rejected(tmp_path):
    make(tmp_path)
    os.truncate(tmp_path / "23/observation.front.bin", 100)
    with pytest.raises(MerlError, match="truncated"):
        make(tmp_path)
    (tmp_path / "23/observation.front.bin").unlink()
    with pytest.raises(MerlError, match="damaged"):
        make(tmp_path)
    (tmp_path / "23/replay.json").write_text("{")
    with pytest.raises(MerlError, match="damaged"):
        make(tmp_path)


def test_file_in_place_of_the_directory_is_rejected(tmp_path):
    (tmp_path / "run").write_text("a file")
    with pytest.raises(MerlError, match="cannot be opened: Not a directory"):
        make(tmp_path / "run" / "replay")
    assert (tmp_path / "run").read_text() == "a file"


# Other types of frames

FRAMES = ReplaySpec(
    config(),
    {
        "depth": KeySpec(np.dtype("<u2"), (4, 5), stacked=True, compressible=True),
        "heat": KeySpec(np.dtype("<f4"), (2, 3), stacked=True),
        "label": KeySpec(np.dtype("u1"), (3, 4, 1)),
        "touch": KeySpec(np.dtype("<f4"), (6, 2)),
    },
    ACTIONS.shape,
    capacity=40,
    rings=2,
)


def typed(ring: int, t: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng((ring, t))
    return {
        "depth": rng.integers(0, 65536, (4, 5)).astype(np.uint16),
        "heat": rng.standard_normal((2, 3), np.float32),
        "label": rng.integers(0, 256, (3, 4, 1)).astype(np.uint8),
        "touch": rng.standard_normal((6, 2), np.float32),
    }


@pytest.mark.parametrize("storage", ["raw", "compressed", "device"])
def test_frames_of_any_type_are_stored_and_stacked_exactly(tmp_path, storage):
    spec = replace(FRAMES, config=config(compress=storage == "compressed"))
    replay = ReplayBuffer(spec, tmp_path)
    assert spec.compressed == (("depth",) if storage == "compressed" else ())
    for t in range(45):  # both rings wrap
        for ring in range(2):
            if t == 0:
                replay.begin(typed(ring, 0), ring)
            else:
                replay.add(Transition(act(ring, t - 1), 0.0, 1.0, typed(ring, t), False), ring)
    if storage == "device":
        copy = DeviceReplay(replay, torch.device("cpu"))
        copy.follow()
        batch = copy.sample(64, torch.Generator().manual_seed(0))
    else:
        batch = replay.sample(64, np.random.default_rng(0))
    for number, (ring, t) in enumerate(batch.action.int().tolist()):
        for key, stored in spec.keys.items():
            for values, newest in (
                (batch.observation[key], t),
                (batch.next_observation[key], min(t + 3, 44)),
            ):
                expected = [typed(ring, newest - back)[key] for back in (2, 1, 0)]
                value = values[number].numpy()
                assert value.dtype == stored.dtype
                np.testing.assert_array_equal(value, expected if stored.stacked else expected[-1])


def test_frames_of_any_type_are_restored_after_growth(tmp_path):
    spec = replace(FRAMES, config=config(compress=True), rings=1)
    replay = ReplayBuffer(spec, tmp_path)
    replay.begin(typed(0, 0))
    for t in range(1, 70):
        replay.add(Transition(act(0, t - 1), 0.0, 1.0, typed(0, t), False))
    before = replay.sample(len(replay), Every())
    larger = ReplayBuffer(replace(spec, capacity=90), tmp_path)
    larger.load_state_dict(replay.state_dict())
    after = larger.sample(len(larger), Every())
    for key in spec.keys:
        held = after.observation[key][-len(before.action) :].numpy()
        np.testing.assert_array_equal(held, before.observation[key].numpy())


def test_float_frames_cannot_be_compressed():
    with pytest.raises(ValueError, match="cannot be compressed"):
        KeySpec(np.dtype("<f4"), (2, 3), stacked=True, compressible=True)


def test_value_of_another_integer_type_is_rejected():
    replay = ReplayBuffer(replace(FRAMES, rings=1))
    with pytest.raises(MerlError, match=r"depth is int32 \(4, 5\), but its space says uint16"):
        replay.begin(typed(0, 0) | {"depth": np.zeros((4, 5), np.int32)})
