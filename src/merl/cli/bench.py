"""The command merl bench."""

from __future__ import annotations

from pathlib import Path

from merl.bench import BENCHES
from merl.cli.output import make_console
from merl.cli.parsing import check_writable, parse, write_json
from merl.core import MerlError, suggest


def bench(args: list[str]) -> int:
    """Time merl and a reference, and print a table: merl bench env."""
    if not args or args[0] in ("-h", "--help"):
        print(f"usage: merl bench {{{','.join(BENCHES)}}} [--repeats N] [--json FILE]")
        return 0
    if args[0] not in BENCHES:
        raise MerlError(f"bench {args[0]!r} is unknown: {suggest(args[0], BENCHES)}")

    def command(repeats: int = 5, json: Path | None = None) -> tuple[int, Path | None]:
        """Time variants of the same work in turns; print medians and ranges.

        Args:
            repeats: How often each variant is timed.
            json: Also write the numbers to this file.
        """
        return repeats, json

    repeats, output = parse(command, f"merl bench {args[0]}", args[1:])
    if repeats < 1:
        raise MerlError(f"--repeats must be at least 1, not {repeats}")
    check_writable(output)
    run, show = BENCHES[args[0]]
    result = run(repeats=repeats)
    make_console().print(show(result))
    if output is not None:
        write_json(output, result)
    return 0
