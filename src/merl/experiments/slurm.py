"""Write planned runs as an array script for Slurm."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from merl.core.files import reporting
from merl.experiments.experiment import PlannedRun
from merl.experiments.sweep import Settings, commands
from merl.runs.run_folder import program


def write_array(
    path: Path, runs: Sequence[PlannedRun], settings: Settings, cpus: float, gpus: float
) -> None:
    """Write a script that runs each run as a task of an array, and requeues what is stopped.

    Args:
        path: file of the script.
        runs: the runs.
        settings: how they are run.
        cpus: processors of each run.
        gpus: GPUs of each run.

    Raises:
        MerlError: the file cannot be written.
    """
    lines = [
        "#!/usr/bin/env bash",
        "#SBATCH --job-name=merl",
        "#SBATCH --ntasks=1",
        f"#SBATCH --array=0-{len(runs) - 1}",
        f"#SBATCH --cpus-per-task={max(1, round(cpus))}",
        *([f"#SBATCH --gpus-per-task={max(1, round(gpus))}"] if gpus else []),
        f'#SBATCH --output="{runs[0].folder.parent}/slurm-%A-%a.log"',
        "#SBATCH --open-mode=append",
        "# Two minutes before its end a run saves; then it is queued again and resumes.",
        "#SBATCH --signal=B:USR1@120 --requeue",
        f"cd {shlex.quote(str(Path.cwd()))}",
        "requeue() {",
        '  kill -USR1 "$child"; wait "$child"',
        '  scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"',
        "  exit 0",
        "}",
        "trap requeue USR1",
        "merl() {",
        f'  command {program()} "$@" & child=$!',
        '  wait "$child"',
        "}",
        'case "$SLURM_ARRAY_TASK_ID" in',
    ]
    for number, run in enumerate(runs):
        both = (f"merl {shlex.join(command)}" for command in commands(run, settings))
        lines.append(f"  {number}) {' && '.join(both)} ;;")
    lines.append("esac")
    with reporting(f"{path} cannot be written"):
        path.write_text("\n".join(lines) + "\n")
