"""`conftest.py` fails a test that is skipped for a reason that is not on its list."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]
CONFTEST = (Path(__file__).parent / "conftest.py").read_text()


@pytest.mark.parametrize("where", ["", "allow_module_level=True"])
@pytest.mark.parametrize(
    ("reason", "passes"), [("no OpenGL library works on this machine", True), ("lazy", False)]
)
def test_a_skip_needs_a_listed_reason(
    pytester: pytest.Pytester, reason: str, passes: bool, where: str
) -> None:
    pytester.makeconftest(CONFTEST)
    skip = f"pytest.skip({reason!r}, {where})"
    body = skip if where else f"def test_it():\n    {skip}"
    pytester.makepyfile(f"import pytest\n{body}")
    result = pytester.runpytest("-p", "no:cacheprovider")
    counts = result.parseoutcomes()
    assert ("skipped" in counts) == passes
    assert ("failed" in counts or "errors" in counts) != passes
