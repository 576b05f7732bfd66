"""The page of a report, as a browser shows it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from merl.report.collect import collect
from merl.report.page import write_report
from runs_on_disk import write_run, write_video

PROBE = """<script>
(async () => {
  const all = selector => [...document.querySelectorAll(selector)];
  await Promise.all(all("video").map(async video => {
    const moved = new Promise(done =>
      video.addEventListener("timeupdate", () => video.currentTime > 0 && done()));
    await video.play();
    await moved;
  }));
  const heading = name => all("th button").find(button => button.textContent === name);
  const column = () => all("table")[0].tBodies[0].querySelectorAll("td:first-child");
  const data = document.body.dataset;
  data.before = [...column()].map(cell => cell.textContent).join(" ");
  heading("final return").click();
  data.up = [...column()].map(cell => cell.textContent).join(" ");
  heading("final return").click();
  data.down = [...column()].map(cell => cell.textContent).join(" ");
  data.videos = all("video").map(video => video.videoWidth).join(" ");
  data.images = all("img").map(image => image.naturalWidth > 0).join(" ");
  data.figures = all("svg").map(svg => svg.getBoundingClientRect().height > 100).join(" ");
  data.wide = document.documentElement.scrollWidth > innerWidth;
  document.title = "probed";
})();
</script></body>"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the report of two variants with two seeds each; one of them has videos."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        run = write_run(
            folder / f"reach_duplo-merl-s{seed}", [9, 150, 200], [0, 0.5, 0.9], seed=seed
        )
        for step in (1000, 3000):
            write_video(run / "videos" / f"{step:08}.mp4")
        write_run(folder / f"reach_duplo-a-s{seed}", [8, 20, 30], [0, 0, 0], seed=seed, tau=0.1)
    groups, notes = collect([folder])
    out = tmp_path_factory.mktemp("report")
    write_report(groups, [*notes, "a note with <angle> & ampersand"], out, "Ours & theirs")
    return out


def test_figures_are_files_too(report: Path) -> None:
    for name in ("return", "success_end"):
        for x in ("steps", "minutes"):
            assert Image.open(report / f"reach_duplo-{name}-{x}.png").width > 1000
            svg = (report / f"reach_duplo-{name}-{x}.svg").read_text()
            assert "merl (2 seeds)" in svg
    assert "scripted expert 230" in (report / "reach_duplo-return-steps.svg").read_text()
    assert {path.suffix for path in report.iterdir()} == {".html", ".csv", ".png", ".svg", ".jpg"}


def test_the_page_needs_no_other_file(report: Path) -> None:
    page = (report / "index.html").read_text()
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert "http" not in re.sub(r"http://(www\.w3|purl|creativecommons)\.org", "", page)
    assert "a note with &lt;angle&gt; &amp; ampersand" in page
    assert "<title>Ours &amp; theirs</title>" in page


@pytest.mark.parametrize("width", [1280, 500])
def test_in_a_browser_every_figure_is_drawn_and_every_video_plays(
    report: Path, tmp_path: Path, width: int
) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    page = tmp_path / "page.html"
    page.write_text((report / "index.html").read_text().replace("</body>", PROBE))
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            "--virtual-time-budget=100000",
            f"--window-size={width},2000",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "CONSOLE" not in done.stderr
    data = dict(re.findall(r'data-(\w+)="([^"]*)"', re.search("<body[^>]*>", done.stdout)[0]))
    assert "<title>probed</title>" in done.stdout
    assert data["before"] == "a merl"
    assert (data["up"], data["down"]) == ("a merl", "merl a")
    assert data["videos"] == "64 64"
    assert data["images"] == "true"
    assert data["figures"].split() == ["true"] * 5
    assert data["wide"] == "false"  # tables and figures scroll, the page does not


def test_the_same_runs_give_the_same_figures(report: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "a-s0", [1, 2, 3], [0, 0, 0])
    groups, notes = collect([run])
    figures = []
    for name in ("first", "second"):
        write_report(groups, notes, tmp_path / name)
        figures.append((tmp_path / name / "reach_duplo-return-steps.svg").read_bytes())
    assert figures[0] == figures[1]


def test_tasks_with_dots_have_figures_of_their_own(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / name, [1, 2], [0, 0], task=f"my.arm:{name}") for name in ("one", "two")
    ]
    write_report(*collect(runs), tmp_path / "out")
    figures = {path.name for path in (tmp_path / "out").glob("*.svg")}
    names = ("return-steps", "return-minutes", "success_end-steps", "success_end-minutes")
    assert figures == {f"my.arm-{run.name}-{name}.svg" for run in runs for name in names}


def test_videos_beyond_the_limit_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = write_run(tmp_path / "a-s0", [1, 2, 3], [0, 0, 0])
    write_video(run / "videos/00003000.mp4")
    os.truncate(run / "videos/00003000.mp4", 1 << 40)  # is not read
    monkeypatch.setattr("merl.report.page.MOST_VIDEO", 10)
    page = write_report(*collect([run]), tmp_path / "out").read_text()
    assert "<video" not in page
    assert "a-s0: its video is left out, to keep the page small" in page
