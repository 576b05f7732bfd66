import resource
import signal
import subprocess
import sys
from fractions import Fraction

import av
import numpy as np
import pytest

from merl.core import MerlError
from merl.evaluation.video import VideoWriter

SIDE = 480


def make_frame(i=0, height=SIDE, width=SIDE):
    """Return a grey frame with a white square whose position depends on i."""
    frame = np.full((height, width, 3), 90, dtype=np.uint8)
    frame[100:160, 20 * i : 20 * i + 60] = 255
    return frame


def names(folder):
    return [path.name for path in folder.iterdir()]


def decode(path):
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
        return stream, stream.codec_context, np.stack(frames).astype(int)


def test_a_video_is_h264_in_real_time(tmp_path):
    path = tmp_path / "videos" / "a.mp4"
    with VideoWriter(path) as video:
        for i in range(10):
            video.add(make_frame(i))
    stream, codec, frames = decode(path)
    assert (codec.name, codec.pix_fmt) == ("h264", "yuv420p")
    assert frames.shape == (10, SIDE, SIDE, 3)
    assert stream.average_rate == 25
    assert stream.duration * stream.time_base == Fraction(10, 25)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays while it is loaded
    assert names(path.parent) == ["a.mp4"]


def test_a_video_shows_the_added_frames(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        for i in range(10):
            video.add(make_frame(i))
    frames = decode(tmp_path / "a.mp4")[2]
    for i, frame in enumerate(frames):
        assert np.abs(frame - make_frame(i)).mean() < 2
        assert frame[130, 20 * i + 30].min() > 240


def test_frame_rate_is_used_and_an_existing_file_is_replaced(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_text("old")
    with VideoWriter(path, fps=12.5) as video:
        video.add(make_frame())
        assert path.read_text() == "old"
    assert decode(path)[0].average_rate == Fraction(25, 2)


def test_odd_sides_lose_one_row_or_column(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(make_frame(height=485, width=641))
    assert decode(tmp_path / "a.mp4")[2].shape == (1, 484, 640, 3)


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(84, 84, (504, 504)), (32, 64, (512, 1024)), (500, 479, (1000, 958))],
)
def test_small_frames_are_enlarged(tmp_path, width, height, size):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(make_frame(width=width, height=height))
    assert decode(tmp_path / "a.mp4")[2].shape[2:0:-1] == size


def test_captions_are_legible_at_the_lower_edge_and_change(tmp_path):
    frame = make_frame()
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(frame)
        video.add(frame, {"task": "reach_duplo", "return": 1.26, "success": False})
        video.add(frame, {"task": "reach_duplo", "return": 1.26, "success": True})
        video.add(frame, {"task": "reach_duplo", "return": np.float32(1.3), "success": True})
    assert (frame == make_frame()).all()
    bare, no, yes, same = decode(tmp_path / "a.mp4")[2]
    strip = slice(SIDE * 7 // 8, None)
    assert np.abs(bare - no)[: strip.start].mean() < 2  # the area above the caption is unchanged
    assert np.median(no[strip]) < 50  # a dark strip ...
    assert no[strip].max() > 230  # ... with white text
    changed = np.abs(no - yes).max(axis=(0, 2)) > 60
    assert changed.any()
    assert changed.nonzero()[0].min() > SIDE * 0.6  # only the third column changes
    assert np.abs(yes - same).mean() < 1  # 1.26 and 1.3 are both shown as 1.3


def test_long_captions_stay_in_their_column(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(make_frame(), {"a": "", "b": 1.0})
        video.add(make_frame(), {"a": "a rather long caption for it" * 2, "b": 1.0})
    short, long = decode(tmp_path / "a.mp4")[2]
    changed = np.abs(short - long).max(axis=(0, 2)).nonzero()[0]
    assert np.abs(short - long)[:, : SIDE // 2].max() > 100
    assert np.abs(short - long)[:, SIDE // 2 + 8 :].max() < 60, changed.max()


@pytest.mark.parametrize(
    "frame",
    [
        make_frame().astype(np.float32),
        make_frame()[..., 0],
        np.zeros((3, SIDE, SIDE), dtype=np.uint8),
    ],
)
def test_refuses_invalid_frames(tmp_path, frame):
    with (
        pytest.raises(MerlError, match="video frame must be uint8"),
        VideoWriter(tmp_path / "a.mp4") as video,
    ):
        video.add(frame)
    assert names(tmp_path) == []


def test_refuses_a_frame_of_another_shape(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4")
    video.add(make_frame())
    with pytest.raises(MerlError, match="but the first one had"):
        video.add(make_frame(height=500))
    video.abort()
    assert names(tmp_path) == []


def test_an_error_leaves_no_file(tmp_path):
    with pytest.raises(KeyError), VideoWriter(tmp_path / "a.mp4") as video:  # noqa: PT012
        video.add(make_frame())
        raise KeyError
    assert names(tmp_path) == []
    with pytest.raises(ValueError, match="closed"):
        video.add(make_frame())


def test_a_video_without_frames_is_refused(tmp_path):
    with pytest.raises(ValueError, match="without frames"), VideoWriter(tmp_path / "a.mp4"):
        pass
    assert names(tmp_path) == []


def test_closing_twice_is_harmless(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4")
    video.add(make_frame())
    video.close()
    video.close()
    video.abort()
    assert decode(tmp_path / "a.mp4")[2].shape[0] == 1


def test_a_killed_writer_leaves_no_file_with_the_final_name(tmp_path):
    code = (
        "import os, signal, sys, numpy as np\n"
        "from merl.evaluation.video import VideoWriter\n"
        "video = VideoWriter(sys.argv[1])\n"
        "for i in range(60): video.add(np.full((480, 480, 3), i, dtype=np.uint8))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.mp4"], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize("limit", [10, 100_000, 1_000_000])
def test_a_full_disk_is_reported_in_one_line(tmp_path, limit):
    rng = np.random.default_rng(0)  # noise, which needs about 4 MB
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(MerlError) as error, VideoWriter(tmp_path / "a.mp4") as video:  # noqa: PT012
            for _ in range(20):
                video.add(rng.integers(0, 255, (SIDE, SIDE, 3), dtype=np.uint8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert "a.mp4 cannot be written" in str(error.value)
    assert "\n" not in str(error.value)
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_created_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MerlError, match=r"a\.mp4 cannot be written"):
        VideoWriter(tmp_path / "file" / "a.mp4")


def test_a_missing_encoder_is_reported_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with pytest.raises(MerlError, match="libx264"):
        VideoWriter(tmp_path / "a.mp4")
    assert names(tmp_path) == []
