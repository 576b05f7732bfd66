from __future__ import annotations

import errno
import json
import logging
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from faults import Faults, with_faults
from merl.agents import make_agent
from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.agents.sac import SACConfig
from merl.core import Batch, MerlError
from merl.runs.checkpoint import Checkpoint, _fingerprint, load_agent, save
from merl.runs.checkpoint_folders import discard_later
from toy import DotEnv

CONFIG = MERLConfig(latent_dim=8, hidden_dim=16, precision="fp32")


def agent(seed: int = 0, config: AgentConfig = CONFIG) -> DDPG:
    env = DotEnv()
    return make_agent(
        "sac" if isinstance(config, SACConfig) else "merl",
        config,
        env.observation_space,
        env.action_space,
        frame_stack=3,
        seed=seed,
        device=torch.device("cpu"),
    )


def make_batch() -> Batch:
    generator = torch.Generator().manual_seed(0)
    observation = {
        "image": torch.randint(0, 256, (4, 3, 16, 16, 3), dtype=torch.uint8, generator=generator),
        "joint": torch.randn(4, 2, generator=generator),
    }
    action, rest = torch.rand(4, 1, generator=generator), torch.ones(4)
    return Batch(observation, action, rest, rest, observation)


def weights(agent: DDPG) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in agent.networks.parameters()])


@pytest.mark.parametrize(
    "config",
    [
        CONFIG,
        replace(CONFIG, fusion="shared"),
        replace(CONFIG, fusion="shared_by_both", target="heads_and_fusion"),
        replace(CONFIG, latent_dim=0),
        SACConfig(keys=None, hidden_dim=16, precision="bf16"),
    ],
    ids=lambda config: f"{type(config).__name__}-{config.fusion}-{config.latent_dim}",
)
def test_save_and_load_restores_the_agent(tmp_path: Path, config: AgentConfig) -> None:
    saved, other = agent(0, config), agent(1, config)
    for one in (saved, other):
        one.update(make_batch(), step=0)
    save(tmp_path, 250, saved, {"a": 1}, score=2.5, keep=2)
    found = Checkpoint.find(tmp_path)
    load_agent(other, found)
    assert (found.step, found.score, found.state()) == (250, 2.5, {"a": 1})
    assert torch.equal(weights(saved), weights(other))
    assert torch.equal(saved.learning.get_state(), other.learning.get_state())
    for one in (saved, other):
        one.update(make_batch(), step=0)
    assert torch.equal(weights(saved), weights(other))


def test_checkpoints_are_sorted_by_number_of_steps(tmp_path: Path) -> None:
    for step in (99_990_000, 99_995_000, 100_000_000):
        save(tmp_path, step, agent(), {}, score=None, keep=2)
    assert Checkpoint.find(tmp_path).step == 100_000_000
    assert not (tmp_path / "99990000").exists()


def test_save_keeps_the_last_and_the_best(tmp_path: Path) -> None:
    for step, score in ((100, 1.0), (200, 9.0), (300, None), (400, 3.0), (500, None)):
        save(tmp_path, step, agent(), {}, score=score, keep=2)
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == [200, 400, 500]
    assert Checkpoint.find(tmp_path, "best").step == 200
    assert Checkpoint.find(tmp_path, "latest").step == 500
    assert Checkpoint.find(tmp_path, "400").step == 400


def test_a_second_save_at_a_step_replaces_the_first(tmp_path: Path) -> None:
    save(tmp_path, 100, agent(), {"a": 1}, score=None, keep=1)
    save(tmp_path, 100, agent(), {"a": 2}, score=3.0, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["00000100"]
    found = Checkpoint.find(tmp_path)
    assert (found.score, found.state()) == (3.0, {"a": 2})


def test_a_second_save_that_fails_at_the_rename_keeps_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 100, agent(), {"a": 1}, score=None, keep=1)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == ".part-00000100":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="Input/output"):
        save(tmp_path, 100, agent(), {"a": 2}, score=None, keep=1)
    assert Checkpoint.find(tmp_path).state() == {"a": 1}


def test_a_checkpoint_that_was_to_be_replaced_is_found(tmp_path: Path) -> None:
    """The process died between the two renames of the only checkpoint."""
    save(tmp_path, 100, agent(), {"a": 1}, score=None, keep=1)
    (tmp_path / "00000100").rename(tmp_path / ".former-00000100")
    assert Checkpoint.find(tmp_path).state() == {"a": 1}
    assert Checkpoint.find(tmp_path, "100").state() == {"a": 1}
    save(tmp_path, 100, agent(), {"a": 2}, score=None, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["00000100"]
    assert Checkpoint.find(tmp_path).state() == {"a": 2}


def test_a_former_checkpoint_that_could_not_be_removed_is_no_obstacle(tmp_path: Path) -> None:
    save(tmp_path, 100, agent(), {"a": 1}, score=None, keep=1)
    shutil.copytree(tmp_path / "00000100", tmp_path / ".former-00000100")
    save(tmp_path, 100, agent(), {"a": 2}, score=None, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["00000100"]
    assert Checkpoint.find(tmp_path).state() == {"a": 2}


@pytest.mark.parametrize("code", [errno.EIO, errno.ESTALE, errno.EACCES])
def test_a_checkpoint_that_the_disk_does_not_read_is_not_skipped(tmp_path: Path, code: int) -> None:
    """It may be whole: resuming from the one before it would discard it."""
    for step in (100, 200):
        save(tmp_path, step, agent(), {}, score=None, keep=2)

    def find() -> int:
        try:
            print(Checkpoint.find(tmp_path).step)
        except MerlError as error:
            print(error)
        return 0

    names = with_faults(find, Faults(tmp_path)).names
    for at in range(1, len(names) + 1, 2):
        out = with_faults(find, Faults(tmp_path, at, code)).out
        assert "cannot be read: " in out, names[at - 1]
        assert out.count("\n") == 1


def test_resuming_before_a_damaged_checkpoint_keeps_the_good_ones(tmp_path: Path) -> None:
    for step in (100, 300):
        save(tmp_path, step, agent(), {}, score=float(step), keep=2)
    (tmp_path / "00000300" / "learner.pt").write_bytes(b"")
    (tmp_path / ".part-00000400").mkdir()
    assert Checkpoint.find(tmp_path).step == 100
    save(tmp_path, 200, agent(), {}, score=None, keep=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00000100", "00000200"]
    assert Checkpoint.find(tmp_path).step == 200


def test_a_skipped_checkpoint_does_not_count_among_those_that_are_kept(tmp_path: Path) -> None:
    """The run resumes before it, and its next checkpoint is after it."""
    for step in (100, 200):
        save(tmp_path, step, agent(), {}, score=None, keep=2)
    (tmp_path / "00000200" / "learner.pt").write_bytes(b"")
    discard_later(tmp_path, Checkpoint.find(tmp_path).step)
    save(tmp_path, 300, agent(), {}, score=None, keep=2)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["00000100", "00000300"]


def test_a_checkpoint_of_another_device_loads(tmp_path: Path) -> None:
    """CUDA's generators have a state of 16 bytes; the noise then restarts from its seed."""
    saved, other, twin = agent(0), agent(1), agent(1)

    class OnCuda:
        @staticmethod
        def state_dict() -> dict[str, object]:
            small = torch.zeros(16, dtype=torch.uint8)
            return saved.state_dict() | {"acting": small, "learning": small}

    save(tmp_path, 1, OnCuda(), {}, score=None, keep=1)  # type: ignore[arg-type]
    load_agent(other, Checkpoint.find(tmp_path))
    assert torch.equal(weights(saved), weights(other))
    assert torch.equal(other.acting.get_state(), twin.acting.get_state())


def test_a_checkpoint_written_on_cuda_resumes_on_the_cpu(tmp_path: Path) -> None:
    """The file claims that its tensors are on cuda:0 and that its Adam is for CUDA graphs."""
    saved, other = agent(0), agent(1)
    saved.update(make_batch(), step=0)
    for optimizer in (saved.critic_optimizer, saved.actor_optimizer):
        optimizer.param_groups[0]["capturable"] = True
    save(tmp_path, 1, saved, {}, score=None, keep=1)
    folder = tmp_path / "00000001"
    file = folder / "learner.pt"
    move_to_cuda(file)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"][file.name] = _fingerprint(file)
    del manifest["checksum"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(RuntimeError, match="CUDA"):
        torch.load(file, weights_only=True)
    load_agent(other, Checkpoint.find(tmp_path))
    assert not other.critic_optimizer.param_groups[0]["capturable"]
    for optimizer in (saved.critic_optimizer, saved.actor_optimizer):
        optimizer.param_groups[0]["capturable"] = False
    for learner in (saved, other):
        learner.learning.manual_seed(0)
        learner.update(make_batch(), step=0)
    assert torch.equal(weights(saved), weights(other))


def move_to_cuda(file: Path) -> None:
    with zipfile.ZipFile(file) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part.replace(b"X\x03\0\0\0cpu", b"X\x06\0\0\0cuda:0"))


@pytest.mark.parametrize("name", ["weights.safetensors", "learner.pt", "state.json"])
@pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "remove"])
def test_a_damaged_checkpoint_is_skipped(
    tmp_path: Path, name: str, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    for step in (100, 200):
        save(tmp_path, step, agent(), {"step": step}, score=None, keep=2)
    file = tmp_path / "00000200" / name
    data = bytearray(file.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
    elif damage == "truncate":
        data = data[:-1]
    elif damage == "empty":
        data = bytearray()
    file.write_bytes(data)
    if damage == "remove":
        file.unlink()
    with caplog.at_level(logging.WARNING):
        assert Checkpoint.find(tmp_path).step == 100
    assert name in caplog.text
    with pytest.raises(MerlError, match=name):
        Checkpoint.find(tmp_path, "200")


def test_a_missing_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MerlError, match="no complete checkpoint"):
        Checkpoint.find(tmp_path)
    with pytest.raises(MerlError, match="does not exist"):
        Checkpoint.find(tmp_path, "300")


def test_an_unknown_format_is_refused(tmp_path: Path) -> None:
    save(tmp_path, 1, agent(), {}, score=None, keep=1)
    manifest = tmp_path / "00000001" / "manifest.json"
    content = json.loads(manifest.read_text()) | {"format": 99}
    del content["checksum"]
    manifest.write_text(json.dumps(content))
    with pytest.raises(MerlError, match="format 99"):
        Checkpoint.open(tmp_path / "00000001")


def test_other_networks_are_refused(tmp_path: Path) -> None:
    save(tmp_path, 1, agent(), {}, score=None, keep=1)
    wider = agent(config=MERLConfig(latent_dim=8, hidden_dim=32, precision="fp32"))
    with pytest.raises(MerlError, match="cannot be loaded"):
        load_agent(wider, Checkpoint.find(tmp_path))


def test_a_failed_save_keeps_the_former_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 100, agent(), {}, score=None, keep=1)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        save(tmp_path, 200, agent(), {}, score=None, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["00000100"]
    assert Checkpoint.find(tmp_path).step == 100


@pytest.mark.parametrize("content", ["[]", "3", "{", "[" * 100_000], ids=lambda text: text[:30])
def test_an_invalid_state_is_refused_in_one_line(tmp_path: Path, content: str) -> None:
    saved = save(tmp_path / "run", 1, agent(), {}, score=None, keep=1)
    (saved.path / "state.json").write_text(content)
    with pytest.raises(MerlError, match="cannot be loaded") as caught:
        saved.state()
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"files": []},
        {"files": {}},
        {"files": {"../../weights.safetensors": {}}},
        {"step": float("inf")},
        {"step": -5},
        {"score": "x"},
        {"score": [1]},
    ],
    ids=str,
)
def test_an_invalid_manifest_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, object]
) -> None:
    saved = save(tmp_path / "run", 1, agent(), {}, score=None, keep=1)
    manifest = saved.path / "manifest.json"
    content = {**json.loads(manifest.read_text()), **change}
    del content["checksum"]
    manifest.write_text(json.dumps(content))
    with pytest.raises(MerlError, match="no readable manifest") as caught:
        Checkpoint.open(saved.path)
    assert len(str(caught.value).splitlines()) == 1


def test_a_folder_named_with_a_superscript_digit_is_ignored(tmp_path: Path) -> None:
    save(tmp_path, 1, agent(), {}, score=None, keep=1)
    (tmp_path / "\N{SUPERSCRIPT TWO}").mkdir()
    assert Checkpoint.find(tmp_path).step == 1


def test_a_pickle_is_refused_and_runs_no_code(tmp_path: Path) -> None:
    import pickle

    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (Path(tmp_path / "owned"),)  # type: ignore[return-value]

    saved = save(tmp_path / "run", 1, agent(), {}, score=None, keep=1)
    for content in (pickle.dumps(Evil()), pickle.dumps(3), b"", b"PK\x03\x04"):
        (saved.path / "learner.pt").write_bytes(content)
        with pytest.raises(MerlError, match=r"cannot be loaded: learner\.pt holds") as caught:
            load_agent(agent(), saved)
        assert "weights_only" not in str(caught.value)  # torch recommends switching it off
    assert not (tmp_path / "owned").exists()
