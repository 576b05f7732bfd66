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


def picture(i=0, height=SIDE, width=SIDE):
    """A grey picture with a white square that moves with i."""
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


def test_is_h264_in_real_time(tmp_path):
    path = tmp_path / "videos" / "a.mp4"
    with VideoWriter(path) as video:
        for i in range(10):
            video.add(picture(i))
    stream, codec, frames = decode(path)
    assert (codec.name, codec.pix_fmt) == ("h264", "yuv420p")
    assert frames.shape == (10, SIDE, SIDE, 3)
    assert stream.average_rate == 25
    assert stream.duration * stream.time_base == Fraction(10, 25)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it has been loaded whole
    assert names(path.parent) == ["a.mp4"]


def test_shows_what_was_added(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        for i in range(10):
            video.add(picture(i))
    frames = decode(tmp_path / "a.mp4")[2]
    for i, frame in enumerate(frames):
        assert np.abs(frame - picture(i)).mean() < 2
        assert frame[130, 20 * i + 30].min() > 240


def test_any_frame_rate_and_an_existing_file_is_replaced(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_text("old")
    with VideoWriter(path, fps=12.5) as video:
        video.add(picture())
        assert path.read_text() == "old"
    assert decode(path)[0].average_rate == Fraction(25, 2)


def test_odd_sides_lose_a_line(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(picture(height=485, width=641))
    assert decode(tmp_path / "a.mp4")[2].shape == (1, 484, 640, 3)


def test_scales_to_a_size(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", size=(600, 500)) as video:
        video.add(picture(), {"return": 1.0})
    assert decode(tmp_path / "a.mp4")[2].shape == (1, 500, 600, 3)


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(84, 84, (504, 504)), (32, 64, (512, 1024)), (500, 479, (1000, 958))],
)
def test_small_pictures_are_enlarged(tmp_path, width, height, size):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(picture(width=width, height=height))
    assert decode(tmp_path / "a.mp4")[2].shape[2:0:-1] == size


def test_captions_are_legible_low_down_and_change(tmp_path):
    frame = picture()
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(frame)
        video.add(frame, {"task": "reach_duplo", "return": 1.26, "success": False})
        video.add(frame, {"task": "reach_duplo", "return": 1.26, "success": True})
        video.add(frame, {"task": "reach_duplo", "return": np.float32(1.3), "success": True})
    assert (frame == picture()).all()
    bare, no, yes, same = decode(tmp_path / "a.mp4")[2]
    strip = slice(SIDE * 7 // 8, None)
    assert np.abs(bare - no)[: strip.start].mean() < 2  # the picture itself is left free
    assert np.median(no[strip]) < 50  # a dark strip ...
    assert no[strip].max() > 230  # ... with white writing
    changed = np.abs(no - yes).max(axis=(0, 2)) > 60
    assert changed.any()
    assert changed.nonzero()[0].min() > SIDE * 0.6  # the third column alone
    assert np.abs(yes - same).mean() < 1  # 1.26 and 1.3 are both written 1.3


def test_long_captions_stay_in_their_column(tmp_path):
    with VideoWriter(tmp_path / "a.mp4") as video:
        video.add(picture(), {"a": "", "b": 1.0})
        video.add(picture(), {"a": "a rather long caption for it" * 2, "b": 1.0})
    short, long = decode(tmp_path / "a.mp4")[2]
    changed = np.abs(short - long).max(axis=(0, 2)).nonzero()[0]
    assert np.abs(short - long)[:, : SIDE // 2].max() > 100
    assert np.abs(short - long)[:, SIDE // 2 + 8 :].max() < 60, changed.max()


@pytest.mark.parametrize(
    "frame",
    [
        picture().astype(np.float32),
        picture()[..., 0],
        np.zeros((3, SIDE, SIDE), dtype=np.uint8),
    ],
)
def test_refuses_what_is_no_picture(tmp_path, frame):
    with pytest.raises(MerlError, match="picture"), VideoWriter(tmp_path / "a.mp4") as video:
        video.add(frame)
    assert names(tmp_path) == []


def test_refuses_a_picture_of_another_shape_and_odd_sizes(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4")
    video.add(picture())
    with pytest.raises(MerlError, match="after"):
        video.add(picture(height=500))
    video.abort()
    for size in ((481, 480), (480, 478)):
        with pytest.raises(ValueError, match="even"):
            VideoWriter(tmp_path / "a.mp4", size=size)
    assert names(tmp_path) == []


def test_an_error_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyError), VideoWriter(tmp_path / "a.mp4") as video:  # noqa: PT012
        video.add(picture())
        raise KeyError
    assert names(tmp_path) == []
    with pytest.raises(ValueError, match="closed"):
        video.add(picture())


def test_a_video_without_a_picture_is_none(tmp_path):
    with pytest.raises(ValueError, match="without"), VideoWriter(tmp_path / "a.mp4"):
        pass
    assert names(tmp_path) == []


def test_closing_twice_is_harmless(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4")
    video.add(picture())
    video.close()
    video.close()
    video.abort()
    assert decode(tmp_path / "a.mp4")[2].shape[0] == 1


def test_a_killed_writer_leaves_nothing_under_the_final_name(tmp_path):
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
def test_a_full_disk_is_one_clear_line(tmp_path, limit):
    rng = np.random.default_rng(0)  # noise, so that there is something to write: about 4 MB
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


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MerlError, match=r"a\.mp4 cannot be written"):
        VideoWriter(tmp_path / "file" / "a.mp4")


def test_no_encoder_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with pytest.raises(MerlError, match="libx264"):
        VideoWriter(tmp_path / "a.mp4")
    assert names(tmp_path) == []
